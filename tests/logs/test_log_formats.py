"""Logs in every format, written by other people's libraries: the same signals; MATLAB's structs."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from facts import holding
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.formats.tables import npz_tables
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.log_paths import log_files
from grounded_trials.logs.signals import SignalSpec, read_signals
from ulog import ulog
from workspaces import make

N, DT, EPOCH = 300, 0.02, 1_700_000_000_000_000_000
TIME = np.arange(N) * DT
X = np.sin(TIME)
STAMPS = EPOCH + np.round(TIME * 1e9).astype(np.int64)


def imu(store, t, x, **header):
    """An Imu message whose angular velocity about z is x."""
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=t // 10**9, nanosec=t % 10**9)
    zero = kinds["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    rate = kinds["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=x)
    return kinds["sensor_msgs/msg/Imu"](
        header=kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="imu", **header),
        orientation=kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=rate,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=zero,
        linear_acceleration_covariance=np.zeros(9),
    )


def fill(writer, store, serialize, ros1=False):
    with writer:
        topic = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        for i, (t, x) in enumerate(zip(STAMPS.tolist(), X.tolist(), strict=True)):
            message = imu(store, t, x, **({"seq": i} if ros1 else {}))
            writer.write(topic, t, serialize(message, "sensor_msgs/msg/Imu"))


def ros2(folder, storage=StoragePlugin.SQLITE3, mode=None, version=9):
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(folder, version=version, storage_plugin=storage)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    fill(writer, store, store.serialize_cdr)
    return folder


def ros1(folder):
    store = get_typestore(Stores.ROS1_NOETIC)
    path = folder.with_suffix(".bag")
    fill(Ros1Writer(path), store, store.serialize_ros1, ros1=True)
    return path


def table(folder, mark=","):
    path = folder.with_suffix(".csv")
    rows = [f"{t!r}{mark}{x!r}" for t, x in zip((TIME + 1.7e9).tolist(), X.tolist(), strict=True)]
    path.write_text("\n".join([f"time [s]{mark}rate (rad/s)", *rows]) + "\n")
    return path


def npz(folder):
    path = folder.with_suffix(".npz")
    np.savez(path, t_ns=STAMPS, rate=X, gain=np.ones(1))
    return path


def parquet(folder):
    arrow = pytest.importorskip("pyarrow", reason="needs the extra parquet")
    from pyarrow.parquet import write_table

    path = folder.with_suffix(".parquet")
    columns = {"time": arrow.array(STAMPS, arrow.timestamp("ns")), "name": ["a"] * N}
    write_table(arrow.table(columns | {"rate": list(np.column_stack([X, X]))}), path)
    return path


def px4(folder):
    topics = {"gyro": (STAMPS // 1000, {"rate": np.column_stack([0 * X, 0 * X, X])})}
    return ulog(folder.with_suffix(".ulg"), topics)


FILE, MESSAGE, MCAP = CompressionMode.FILE, CompressionMode.MESSAGE, StoragePlugin.MCAP
IMU = "/imu.angular_velocity.z"
LOGS = {
    "db3": (ros2, IMU),
    "db3 without definitions": (lambda f: ros2(f, version=8), IMU),
    "db3, files compressed": (lambda f: ros2(f, mode=FILE), IMU),
    "db3, messages compressed": (lambda f: ros2(f, mode=MESSAGE), IMU),
    "mcap": (lambda f: ros2(f, MCAP), IMU),
    "mcap, files compressed": (lambda f: ros2(f, MCAP, FILE), IMU),
    "mcap, messages compressed": (lambda f: ros2(f, MCAP, MESSAGE), IMU),
    "ros 1": (ros1, IMU),
    "csv": (table, "/csv.rate"),
    "csv with semicolons": (lambda f: table(f, ";"), "/csv.rate"),
    "npz": (npz, "/npz.rate"),
    "parquet": (parquet, "/parquet.rate[1]"),
    "px4": (px4, "/gyro.rate[2]"),
}


def file_of(path):
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


@pytest.mark.parametrize("kind", LOGS)
def test_every_format_gives_the_same_signal(tmp_path, kind):
    make, path = LOGS[kind]
    log = make(tmp_path / "log")
    for given in {log, file_of(log)}:
        found = read_signals(given, {"r": SignalSpec(path)})["r"]
        np.testing.assert_allclose(found.values, X, atol=1e-7)
        np.testing.assert_allclose(found.t, STAMPS, atol=500)
    report = inspect_log(log)
    assert report.messages == N and report.duration_s == pytest.approx((N - 1) * DT, abs=1e-3)
    assert path in [field.path for topic in report.topics for field in topic.fields]


@pytest.mark.parametrize("kind", LOGS)
def test_a_damaged_log_is_refused_or_ends_early(tmp_path, kind, capsys):
    """Cut in the middle, or with its middle overwritten: a clear error or fewer samples."""
    make, path = LOGS[kind]
    source = file_of(make(tmp_path / "log"))
    content = source.read_bytes()
    middle = len(content) // 2
    for i, bad in enumerate([content[:middle], content[:40], content[:middle] + bytes(400)]):
        copy = tmp_path / f"bad{i}{''.join(source.suffixes)}"
        copy.write_bytes(bad)
        try:
            found = read_signals(copy, {"r": SignalSpec(path)})["r"]
        except GroundedError as error:
            assert copy.name.removesuffix(".zstd") in str(error) or "'r'" in str(error)
        else:
            assert (len(found.values) < N and np.isin(found.t, STAMPS).all()) or "csv" in kind
    assert capsys.readouterr() == ("", "")  # pyulog prints; stdout is for the data of --json


@pytest.mark.parametrize(
    "text",
    [
        "Zeit_s;x\n0,5;1\n0,75;2\n",
        "Zeit [ms];x\n500;1\n750;2\n",
        "temps;x\n0.5;1\n0.75;2\n",
        "tempo,t,x\n9,0.5,1\n3,0.75,2\n",
        "Trace V2\nPLC: B-1; cycle 10 ms\n\ntime_ms;x\n500;1\n750;2\n",
        "Device;B-1;\nCycle;10;ms\n\nZeit;x;\nms;deg;\n500;1;\n750;2;\n",
        "time,x\n2026-11-21 10:05:00.500,1\n2026-11-21T10:05:00.75Z,2\n",
        "time;x\n21.11.2026 23:59:59,75;1\n22.11.2026 00:00:00;2\n",
        "Uhrzeit;x\n23:59:59,75;1\n0:00:00,000;2\n",
        "Date;Time;x\n21.11.2026;23:59:59.75;1\n22.11.2026;00:00:00;2\n",
        "Datum;x\n21.11.2026 08:06:26.5;1\n21.11.2026 08:06:26.75;2\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
def test_tables_as_a_plc_or_another_language_writes_them(tmp_path, text, encoding):
    path = tmp_path / "log.csv"
    path.write_text(text.replace("x", "größe"), encoding=encoding)
    found = read_signals(path, {"x": SignalSpec('/csv."größe"')})["x"]
    assert found.values.tolist() == [1, 2] and np.diff(found.t).tolist() == [250_000_000]


def test_a_table_cut_in_its_last_row_ends_before_it_and_its_unit_counts(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("Time [ms],x\n0,1.5\n20,2.5\n4")
    found = read_signals(path, {"x": SignalSpec("/csv.x")})["x"]
    assert found.values.tolist() == [1.5, 2.5] and found.t.tolist() == [0, 20_000_000]
    (cut,) = inspect_log(path).about[0].findings
    assert cut.facts["text"] == "4" and cut.code == "file.cut"
    for whole in ("t,x\n0,1.5\n20,2.5", "t,x\n0,1.5\n20,2.5\n", "t,x\n0,1.5\n\n\n"):
        path.write_text(whole)
        assert not inspect_log(path).about[0].findings
    rows = [f"{0.1 * k:.2f},{k}.25,{k}.125" for k in range(30)]
    # half a number, a row that is too short, the zero bytes of a power loss
    for tail in ("2.90,29.2", "2.90,29.25\n", "2.90,29.25,-", "2.90,29.\0\0\0\0"):
        path.write_text("\n".join(["t,x,v", *rows[:29], tail]))
        seen = read_signals(path, {"v": SignalSpec("/csv.v")})["v"]
        assert seen.values.tolist() == [k + 0.125 for k in range(29)] and seen.findings, tail
    path.write_text("\n".join(["t,x,v", *rows[:9], "0.90,9.25", *rows[10:]]) + "\n")
    with pytest.raises(GroundedError):  # not at the end: something else went wrong
        read_signals(path, {"v": SignalSpec("/csv.v")})
    path.write_text("elapsed_us,x\n0,1.5\n20,2.5\n")
    assert read_signals(path, {"x": SignalSpec("/csv.x")})["x"].t.tolist() == [0, 20_000]


@pytest.mark.parametrize(
    "text, holds",
    [
        ("1,2\n3,4\n", ("1,2", "--columns")),
        ("a,b\n3,4\n", ("a and b", "'t'")),
        ("t,b\n0,4\n1\n2,4", ("line 3", "1", "2")),
        ("t,b\n1e30,4\n", ("'t'", "1e+30")),
        ("time,b\nyesterday,4\n", ("line 2", "'time'", "'yesterday'", "2026-11-21 10:05:00")),
        ("time,b\n0,4\n,4\n", ("'time'", "1 row")),
        ("t,b\n0,0,5\n1,0,75\n", ("line 2", "3 cells", "2 columns", "decimal sign", "semicolons")),
        ("t,b\n0,0.5\n1,0.75,9\n", ("line 3", "3 cells", "2 columns")),  # was stored without the 9
        ("", ("log.csv",)),
    ],
)
def test_tables_that_are_none(tmp_path, text, holds):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(GroundedError) as error:
        read_signals(path, {"x": SignalSpec("/csv.b")})
    assert all(part in str(error.value) for part in holds), error.value


def test_many_zeros_in_a_small_file_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("GROUNDED_FILE_MB", "20")
    path = tmp_path / "bomb.npz"

    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("x.npy", "w") as f,
    ):
        for _ in range(200):
            f.write(bytes(2**20))
    with pytest.raises(GroundedError, match="GROUNDED_FILE_MB"):
        read_signals(path, {"x": SignalSpec("/npz.x")})


def test_each_table_of_an_npz_has_its_own_column_names(tmp_path):
    path, t = tmp_path / "two.npz", np.linspace(0, 1, 5)
    np.savez(
        path,
        mocap=np.zeros((5, 2)),
        mocap_t=t,
        mocap_names=np.array(["x", "v"]),
        cmd=np.ones((5, 2)),
        cmd_t=t,
        cmd_names=np.array(["left", "right"]),
    )
    found = read_signals(path, {"v": SignalSpec("/mocap.v"), "u": SignalSpec("/cmd.left")})
    assert found["v"].values.max() == 0 and found["u"].values.min() == 1


def test_a_file_is_told_by_its_content(tmp_path):
    log = file_of(ros2(tmp_path / "log"))
    renamed = log.rename(Path(tmp_path / "log.dat"))
    assert inspect_log(renamed).messages == N
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0" + bytes(100))
    with pytest.raises(GroundedError, match=r"photo\.jpg"):
        inspect_log(tmp_path / "photo.jpg")


def test_zstd_files_of_any_log(tmp_path):
    plain = table(tmp_path / "log")
    packed = tmp_path / "log.csv.zst"
    packed.write_bytes(zstandard.compress(plain.read_bytes()))
    assert inspect_log(packed).messages == N


def test_an_exported_candidate_is_no_log(cart_candidate):
    folder, file = cart_candidate
    with pytest.raises(GroundedError, match=holding("c0001.npz", "candidate c0001")):
        list(npz_tables(file))
    (folder / "drive1.csv").write_text("t,x\n0,0\n")
    with pytest.raises(GroundedError, match=holding("drive1.csv")):
        log_files(folder / "drive.csv")


@pytest.fixture
def cart_candidate(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    w.export(w.propose().candidate.id, tmp_path / "c0001.npz", form="npz")
    return tmp_path, tmp_path / "c0001.npz"


def test_a_table_that_ends_with_a_state_after_its_last_command_is_whole(tmp_path):
    """As a trial is exported: the last state has no command."""
    rows = [f"{t:.2f},{x:.6f},{x:.6f}" for t, x in zip(TIME, X, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["t,x,u", *rows[:-1], rows[-1][:-9] + ","]) + "\n")
    report = inspect_log(tmp_path / "run.csv")
    assert not report.findings and not any(one.not_finite for one in report.numbers)
    signals = {"u": SignalSpec("/csv.u", clock="log")}
    assert len(read_signals(tmp_path / "run.csv", signals)["u"].t) == N - 1


ROWS = 200
T = np.arange(ROWS) * 0.01
Q = np.sin(T)


def mat5(path: Path, content: Mapping[str, Any]) -> Path:
    from scipy.io import savemat

    savemat(path, _cells(content))
    return path


def _cells(value: Any) -> Any:
    """Lists become arrays of structs or cell arrays, as `savemat` wants them."""
    if isinstance(value, Mapping):
        return {key: _cells(one) for key, one in value.items()}
    if isinstance(value, list):
        cells = np.empty(len(value), object)
        cells[:] = [_cells(one) for one in value]
        return cells
    return value


def mat73(path: Path, content: Mapping[str, Any]) -> Path:
    h5py = pytest.importorskip("h5py", reason="needs the extra matlab")

    def put(group: Any, name: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            made = group.create_group(name)
            made.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, one in value.items():
                put(made, key, one)
            return made
        if isinstance(value, list):
            refs = group.file.require_group("#refs#")
            held = [put(refs, f"{name}{len(refs)}{i}", one).ref for i, one in enumerate(value)]
            made = group.create_dataset(name, data=np.array(held, h5py.ref_dtype)[None])
            made.attrs["MATLAB_class"] = np.bytes_("cell")
            return made
        text = isinstance(value, str)
        data = np.array([[ord(c)] for c in value], np.uint16) if text else np.asarray(value).T
        made = group.create_dataset(name, data=data)
        made.attrs["MATLAB_class"] = np.bytes_("char" if text else "double")
        return made

    with h5py.File(path, "w", userblock_size=512) as file:
        for key, one in content.items():
            put(file, key, one)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")
    return path


COLUMN, BOTH = T[:, None], np.column_stack([Q, 2 * Q])
SIMULINK = {"time": COLUMN, "signals": [{"values": Q[:, None], "label": "q"}]}
SERIES = {"Time": COLUMN, "Data": Q[:, None]}


CONTENTS: dict[str, tuple[dict[str, Any], str]] = {
    "arrays": ({"t": COLUMN, "q": Q[:, None], "gain": 3.0, "who": "me"}, "/mat.q"),
    "rows": ({"tout": T[None], "q": BOTH.T}, "/mat.q[0]"),
    "a struct": ({"run": {"t": COLUMN, "q": BOTH, "date": "today"}}, "/run.q[0]"),
    "structs inside": ({"run": {"t": COLUMN, "arm": {"q": Q[:, None]}}}, "/run/arm.q"),
    "structure with time": ({"ScopeData": SIMULINK}, "/ScopeData.q"),
    "logsout": ({"logsout": [{"Name": "q", "Values": SERIES}]}, "/logsout.q"),
    "two of logsout": ({"logsout": {"q": SERIES, "w": SERIES}}, "/logsout.q"),
}


@pytest.mark.parametrize("write", [mat5, mat73])
@pytest.mark.parametrize("kind", CONTENTS)
def test_the_numbers_have_paths(tmp_path: Path, write: Any, kind: str) -> None:
    content, path = CONTENTS[kind]
    log = write(tmp_path / "log.mat", content)
    found = read_signals(log, {"q": SignalSpec(path)})["q"]
    np.testing.assert_array_equal(found.values, Q)
    np.testing.assert_allclose(found.t, T * 1e9, atol=1)
    report = inspect_log(log)
    assert len(report.topics) == 1 and path in report.moving


def test_signals_on_two_clocks_are_two_topics(tmp_path: Path) -> None:
    slow = {"Time": T[::10], "Data": Q[::10]}
    log = mat5(tmp_path / "log.mat", {"logsout": {"q": SERIES, "w": slow}})
    assert [one.messages for one in inspect_log(log).topics] == [ROWS, ROWS // 10]


def test_objects_of_matlab_are_refused_by_name(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="needs the extra matlab")
    log = mat73(tmp_path / "log.mat", {"logsout": np.zeros(6)})
    with h5py.File(log, "r+") as file:
        file["logsout"].attrs["MATLAB_class"] = np.bytes_("timeseries")
        file["logsout"].attrs["MATLAB_object_decode"] = np.int32(3)
    with pytest.raises(GroundedError, match=holding("logsout", "timeseries")):
        inspect_log(log)


def test_links_out_of_the_file_are_not_followed(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="needs the extra matlab")
    mat73(tmp_path / "other.mat", {"run": {"t": T, "q": Q}})
    log = mat73(tmp_path / "log.mat", {"t": T, "q": Q})
    with h5py.File(log, "r+") as file:
        file["run"] = h5py.ExternalLink("other.mat", "/run")
    assert [one.topic for one in inspect_log(log).topics] == ["/mat"]


@pytest.mark.parametrize("write", [mat5, mat73])
def test_a_damaged_file_is_refused(tmp_path: Path, write: Any) -> None:
    log = write(tmp_path / "log.mat", {"t": T, "q": Q})
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(GroundedError, match=holding("log.mat")):
        inspect_log(log)
