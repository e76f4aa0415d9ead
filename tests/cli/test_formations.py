"""`wholearm formations`: what can come next, with poses and turns; in a scene without phases, what can begin."""

import json
import math

import pytest
import tomli_w
from support import layered, layered_file

from wholearm_jax.files.scene_toml import to_dict

SLIDE = ["palm:v5", "palm:v6", "finger1:v1", "finger2:v3"]


def test_what_follows_a_phase(wholearm, tmp_path):
    code, out, err = wholearm("formations", layered_file("heptagon"), "--after", "0", "--json", "--out", tmp_path)
    assert (code, err) == (0, "")
    answer = json.loads(out)
    assert set(SLIDE) < set(answer["touching"])
    flip = next(
        r for r in answer["formations"] if set(r["contacts"]) == {"palm:v6", "finger1:v1", *SLIDE[3:], "finger2:v4"}
    )
    begin, end = flip["begin"], flip["end"]
    assert flip["turn_degrees"] == pytest.approx(math.degrees(end["phi"] - begin["phi"]))
    assert flip["turn_degrees"] < -40
    assert flip["displacement"] == pytest.approx([end["x"] - begin["x"], end["y"] - begin["y"]])
    assert {f"formations.{kind}" for kind in ("png", "svg", "pdf")} == {path.name for path in tmp_path.iterdir()}


def test_rolling_formations_stand_beside_sliding_ones(wholearm):
    code, out, _ = wholearm("formations", layered_file("tipping"), "--json")
    assert code == 0
    rows = json.loads(out)["formations"]
    planned = set(layered("tipping").phases[0].formation.names)
    assert any(name.endswith(" rolling") for name in planned)
    (same,) = {row["status"] for row in rows if set(row["contacts"]) == planned}
    assert same == "ok"


@pytest.mark.parametrize("width", [40, 120])
def test_the_table_fits_and_has_poses(width, wholearm, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    code, out, _ = wholearm("formations", layered_file("heptagon"))
    assert code == 0
    assert max(map(len, out.splitlines())) <= width
    for word in ("ends at", "turn", "rolling", "palm:v5"):
        assert word in out


def test_a_scene_without_phases_lists_what_can_begin(wholearm, tmp_path):
    """The heptagon, laid in the hand roughly: its first phase is among what can begin, where its plan begins."""
    data = to_dict(layered("heptagon"))
    del data["phase"]
    path = tmp_path / "scene.toml"
    path.write_text(tomli_w.dumps(data))
    code, out, err = wholearm("formations", path, "--json")
    assert (code, err) == (0, "")
    answer = json.loads(out)
    assert set(SLIDE) <= set(answer["touching"])
    rows = [row for row in answer["formations"] if set(row["contacts"]) == set(SLIDE)]
    assert {row["toward"] for row in rows} == {"x-", "x+"}
    assert rows[0]["begin"]["phi"] == pytest.approx(-0.2587709, abs=1e-6)
    code, out, err = wholearm("formations", path, "--after", "0")
    assert code == 2
    assert "no such phase" in err


def test_other_commands_still_need_phases(wholearm, tmp_path):
    data = to_dict(layered("heptagon"))
    del data["phase"]
    path = tmp_path / "scene.toml"
    path.write_text(tomli_w.dumps(data))
    advice = "; `wholearm plan` finds them, and in Python `wa.plan(wa.load_start(...), ...)`"
    code, _, err = wholearm("optimise", path)
    assert (code, err) == (2, f"wholearm: {path}: phase: missing{advice}\n")
    path.write_text(tomli_w.dumps(data | {"phase": []}))
    code, _, err = wholearm("optimise", path)
    assert code == 2
    assert err.startswith(f"wholearm: {path}: phase: ")
    assert err.endswith(f"{advice}\n")
