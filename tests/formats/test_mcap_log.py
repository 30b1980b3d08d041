"""Trials and candidates as files: they come back to the last bit, or not at all."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from facts import holding
from grounded.errors import GroundedError, NextCommand
from grounded.trial import Trial
from grounded_trials.formats.mcap_records import Schema
from grounded_trials.formats.protobuf import file_descriptor_set, numbers_in
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.store.trial_file import TrialWriter, read_trial, trial_bytes, write_trial
from rewriting import with_metadata
from small_tasks import a_policy


def a_trial(steps: int = 40, seed: int = 0) -> Trial:
    rng = np.random.default_rng(seed)
    return Trial(
        states=rng.normal(size=(steps + 1, 3)),
        inputs=rng.normal(size=(steps, 2)),
        dt=0.05,
        state_names=("v", "x", "psi"),
        input_names=("steering", "throttle"),
        candidate="c0003",
        start_inputs=np.array([0.1, -0.0]),
    )


def test_a_trial_comes_back_exactly() -> None:
    trial = a_trial()
    odd = trial.states.copy()
    odd[3] = [np.nan, np.inf, -0.0]
    odd[4] = [5e-324, 1.7e308, 0.1 + 0.2]
    trial = replace(trial, states=odd)
    meta = {"iteration": "3", "alpha": repr(0.1), "note": 'a "quoted" ü\nline'}
    source = trial_bytes(trial, meta, b"policy", state_units={"v": "m/s"})
    back, found, policy = read_trial(source)
    assert back.states.tobytes() == trial.states.tobytes()
    assert back.inputs.tobytes() == trial.inputs.tobytes()
    assert back.start_inputs is not None and trial.start_inputs is not None
    assert back.start_inputs.tobytes() == trial.start_inputs.tobytes()
    assert (back.dt, back.state_names) == (0.05, trial.state_names)
    assert back.input_names == trial.input_names
    assert back.candidate == "c0003" and len(back.id) == 64
    assert {k: found[k] for k in meta} == meta and policy == b"policy"
    assert json.loads(found["states"]) == {"v": "m/s", "x": "1", "psi": "1"}


@pytest.mark.parametrize("feedback", [True, False])
def test_a_candidate_comes_back_exactly(feedback: bool, tmp_path: Path) -> None:
    policy, rng = a_policy(feedback=feedback), np.random.default_rng(2)
    x, u = rng.normal(size=(21, 3)), rng.normal(size=(20, 2))
    path = tmp_path / "c0001.mcap"
    path.write_bytes(encoded_candidate(policy, x, u, {"alpha": "0.5"})[0])
    back, px, pu, meta = read_candidate(path)
    for part in ("feedforward", "low", "high", "past", "gain", "reference"):
        mine, theirs = getattr(policy, part), getattr(back, part)
        assert (mine is None and theirs is None) or mine.tobytes() == theirs.tobytes()
    for part in ("dt", "state_names", "input_names", "depths", "angles"):
        assert getattr(policy, part) == getattr(back, part)
    assert np.array_equal(px, x) and np.array_equal(pu, u) and meta["alpha"] == "0.5"


def test_other_tools_read_named_fields() -> None:
    trial = a_trial()
    reader = make_reader(
        io.BytesIO(trial_bytes(trial, {})), decoder_factories=[DecoderFactory()], validate_crcs=True
    )
    seen = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/state"])]
    assert [s.x for s in seen] == trial.states[:, 1].tolist()
    candidate = encoded_candidate(a_policy(), np.zeros((21, 3)), np.zeros((20, 2)), {})[0]
    reader = make_reader(io.BytesIO(candidate), decoder_factories=[DecoderFactory()])
    seen = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/policy"])]
    gain = a_policy().gain
    assert gain is not None and list(seen[5].gain) == gain[5].ravel().tolist()
    summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert (summary.statistics.metadata_count, summary.statistics.attachment_count) == (1, 1)


def test_a_live_trial_that_is_cut_off_keeps_all_but_its_last_second(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    writer = TrialWriter(path, 0.02, {"x": "m"}, {"u": "1"}, {})
    for k in range(250):
        writer.append(k * 0.02, np.array([k]), np.array([-k]))
    on_disk = path.stat().st_size  # without close: the battery is gone
    assert on_disk > 0.75 * 250 * 2 * 40
    with pytest.raises(GroundedError) as refused:
        read_trial(path)
    assert refused.value.then == NextCommand("recover", (str(path),))
    writer.close()
    writer.close()
    trial, _, _ = read_trial(path)
    assert trial.steps == 249  # the last input led to no state


def test_a_writer_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "trial.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(GroundedError, match="exists already"):
        TrialWriter(path, 0.1, {"x": "m"}, {"u": "1"}, {})
    assert path.read_bytes() == b"precious"


def test_refusals() -> None:
    with pytest.raises(GroundedError, match=holding("'dt'")):
        trial_bytes(a_trial(), {"dt": "1"})
    policy, x, u = a_policy(), np.zeros((21, 3)), np.zeros((20, 2))
    gain = np.array(policy.gain)
    gain[7, 0, 0] = np.nan
    with pytest.raises(GroundedError, match=holding("gain", "step 7")):
        encoded_candidate(replace(policy, gain=gain), x, u, {})
    with pytest.raises(GroundedError, match=holding("(21, 3)", "(20, 3)")):
        encoded_candidate(policy, x[1:], u, {})
    with pytest.raises(GroundedError, match=holding("grounded trial 1", "grounded candidate 1")):
        read_trial(encoded_candidate(policy, x, u, {})[0])
    with pytest.raises(GroundedError, match=holding("grounded trial 1", "grounded candidate 1")):
        read_candidate(trial_bytes(a_trial(), {}))
    with pytest.raises(GroundedError, match=holding("/nowhere/t.mcap")):
        read_trial("/nowhere/t.mcap")
    with pytest.raises(GroundedError, match=holding("/nowhere/t.mcap")):
        write_trial("/nowhere/t.mcap", a_trial(), {})


def test_reading_needs_no_mcap_and_no_protobuf() -> None:
    import subprocess
    import sys

    code = (
        "import sys; from grounded_trials.store.trial_file import read_trial; "
        "read_trial(sys.stdin.buffer.read()); "
        "bad = [m for m in sys.modules if m.split('.')[0] in ('mcap', 'google', 'zstandard')]; "
        "sys.exit(bool(bad) and str(bad))"
    )
    source = trial_bytes(a_trial(), {})
    subprocess.run([sys.executable, "-c", code], input=source, check=True)


def test_a_file_without_its_checksum_is_refused() -> None:
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.add_metadata("grounded", {"format": "grounded trial 1"})
    writer.finish()
    with pytest.raises(GroundedError, match="checksum"):
        read_trial(stream.getvalue())


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("names", [[], ["x"], ["n" * 10, "k" * 33, "w" * 127], ["ü"], ["w" * 130]])
def test_our_own_definitions_are_known_without_the_library(
    names: list[str], repeated: bool
) -> None:
    data = file_descriptor_set("State", names, repeated=repeated)
    found = numbers_in(Schema(1, "grounded.State", "protobuf", data))
    assert found == {name: (i, repeated) for i, name in enumerate(names, start=1)}
    other = file_descriptor_set("State", names, repeated=repeated).replace(b"proto3", b"proto2")
    assert numbers_in(Schema(1, "grounded.State", "protobuf", other)) == found


def test_a_live_trial_on_a_full_disk_says_so() -> None:
    class Full(io.BytesIO):
        def write(self, data: object) -> int:
            if self.tell() > 3000:
                raise OSError(28, "ENOSPC, full disk")
            return super().write(data)  # type: ignore[arg-type]

    writer = TrialWriter(Full(), 0.1, {"x": "m"}, {"u": "1"}, {})
    with pytest.raises(GroundedError, match=holding("ENOSPC, full disk")):
        for k in range(1000):
            writer.append(k * 0.1, np.zeros(1), np.zeros(1))
    with pytest.raises(GroundedError, match=holding("(1,)", "(2,)")):
        writer.append(0.0, np.zeros(2), None)


NASTY = ["", "x", "-1", "0", "1e999", "nan", "inf", "null", "[]", "{}", "[[[1]]]", "[1e999, 2]"]


@pytest.mark.parametrize("value", [None, *NASTY])
def test_a_strangers_metadata_is_read_or_refused_with_a_message(value: str | None) -> None:
    trial = trial_bytes(a_trial(4), {})
    candidate = encoded_candidate(a_policy(), np.zeros((21, 3)), np.zeros((20, 2)), {})[0]
    candidate = with_metadata(candidate, "sha256", None)  # else it alone would refuse everything
    for key in ("dt", "states", "inputs", "candidate", "start_inputs", "start_ns"):
        try:
            found, _, _ = read_trial(with_metadata(trial, key, value))
        except GroundedError as error:
            assert len(str(error)) < 500
        else:
            assert found.steps == 4 and found.dt > 0
    table = json.loads(read_candidate(candidate)[3]["policy"])
    for key in ("dt", "states", "inputs", "steps", "policy", *table):
        changed = value
        if key in table:
            try:
                inner = {**table, key: json.loads(value or "null")}
            except (ValueError, RecursionError):
                continue
            key, changed = "policy", json.dumps(inner)
        try:
            policy, _, _, _ = read_candidate(with_metadata(candidate, key, changed))
        except GroundedError as error:
            assert len(str(error)) < 500
        else:
            assert policy.horizon == 20 and np.isfinite(policy.feedforward).all()
