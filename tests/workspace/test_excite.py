"""`excite` writes a drive before there is a target; its log is data like any other."""

import pytest

from cli import grounded
from grounded.errors import GroundedError
from grounded_trials import Workspace
from workspaces import CONFIG, MODEL, make

BARE = CONFIG.replace('target = "target.csv"\n', "").replace("state = { x = 10.0 }\n", "")
SAFE = BARE + "\n[safety]\nx = [-2.0, 2.0]\n"


def codes(done):
    return [one["code"] for one in done["findings"]]


def test_from_a_bare_model_to_fitted_values(tmp_path):
    w = make(tmp_path / "w", config=SAFE).folder
    made = grounded("-C", w, "excite", "--seconds", "5", "--json").json
    assert made["seconds"] == 5.0 and not made["feedback"] and codes(made) == []
    for one in made["parameters"].values():
        assert one["std_after"] < 0.1 * one["std"]
    ran = grounded("-C", w, "run", made["candidate"], "--json").json
    assert grounded("-C", w, "ingest", ran["trial_file"]).code == 0
    fitted = grounded("-C", w, "fit", "--json").json["params"]
    assert fitted["mass"]["value"] == pytest.approx(1.4, rel=0.2)  # its latency is not in the model
    assert grounded("-C", w, "fit", "--apply").code == 0  # what is known better is begun with
    again = grounded("-C", w, "excite", "--seconds", "5", "--json").json["parameters"]["mass"]
    assert again["std"] < 0.1 * made["parameters"]["mass"]["std"]
    csv = grounded("-C", w, "export", made["candidate"], "-o", tmp_path / "drive.csv")
    assert csv.code == 0 and (tmp_path / "drive.csv").read_text().count("\n") > 100


CERTAIN = MODEL.replace(', "kg", 0.1, 10.0', "").replace(', "N s/m", 0.0, 5.0', "")
STUCK = MODEL.replace("a.force", "0.0 * a.force")


@pytest.mark.parametrize(
    ("files", "seconds", "code"),
    [
        ({"config": BARE}, None, "plan.no_drive"),
        ({"config": SAFE.replace("force = [-5.0, 5.0]", "")}, None, "plan.no_limits"),
        ({"config": SAFE, "model": CERTAIN}, None, "given.constant"),
        ({"config": SAFE, "model": STUCK}, None, "plan.without_effect"),
        ({"config": SAFE}, 0.01, "given.value"),
        ({"config": SAFE + "v = [0.5, 0.6]\n"}, None, "plan.no_drive"),
    ],
)
def test_what_is_missing_is_told(tmp_path, files, seconds, code):
    w = Workspace(make(tmp_path / "w", **files).folder)
    with pytest.raises(GroundedError) as refused:
        w.excite(seconds)
    assert refused.value.finding.code == code
