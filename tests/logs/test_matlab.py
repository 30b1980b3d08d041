"""MATLAB files: structs of time series, plain arrays, Simulink's structures; versions 5 and 7.3."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.signals import SignalSpec, read_signals

N = 200
T = np.arange(N) * 0.01
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
    assert [one.messages for one in inspect_log(log).topics] == [N, N // 10]


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
