"""Result files: trajectories and summaries are consistent, files are whole or absent."""

import csv
import json
import os
import pathlib

import equinox as eqx
import numpy as np
import pytest
from support import layered

from wholearm_jax.core.atomic_files import write_atomically
from wholearm_jax.core.status import Status
from wholearm_jax.files.results import summary, write_summary, write_trajectory
from wholearm_jax.files.scene_toml import parse, to_dict
from wholearm_jax.model.schedule import torque_schedule
from wholearm_jax.phases.plan_simulation import simulate

HEADER = (
    "t,phase,x,y,phi,theta1,theta2,x_dot,y_dot,phi_dot,theta1_dot,theta2_dot,tau1,tau2,cn1,cn2,cn3,cn4,ct1,ct2,ct3,ct4"
)


@pytest.fixture(scope="module")
def pushed():
    """The heptagon pushed to the left in two phases under constant torques, each arriving with the speed it has."""
    data = to_dict(layered("heptagon"))
    slide = data["phase"][0] | {"arrive": "caught", "duration": 0.3}
    data["phase"] = [slide | {"name": "near", "until": {"x": 0.0}}, slide | {"name": "far"}]
    result = simulate(parse(data), torque_schedule([0.0, 0.3, 0.3, 0.6], [[0.55, -0.24]] * 2 + [[0.5, -0.1]] * 2))
    assert result.status is Status.OK, result.message
    return result


@pytest.fixture(scope="module")
def still(pushed):
    """The same without torques: friction holds the object."""
    return simulate(pushed.scene, torque_schedule([0.0, 0.6], np.zeros((2, 2))))


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def numbers(row, names):
    return np.array([float(row[name]) for name in names])


# --- trajectories and summaries --------------------------------------------------------------------------------------


def test_trajectory_ends_each_phase_where_its_path_ends(pushed, tmp_path):
    path = tmp_path / "trajectory.csv"
    write_trajectory(pushed, path, samples=11)
    assert path.read_text().splitlines()[0] == HEADER
    rows = rows_of(path)
    assert [row["phase"] for row in rows] == ["near"] * 11 + ["far"] * 11
    for k, phase in enumerate(pushed.phases):
        last = rows[11 * k + 10]
        assert float(last["t"]) == pytest.approx(phase.start + phase.duration)
        there = numbers(last, ("x", "y", "phi", "theta1", "theta2"))
        np.testing.assert_allclose(there, phase.traced.end, rtol=0, atol=1e-8)
    assert float(rows[10]["x"]) == pytest.approx(0.0, abs=1e-9)


def test_trajectory_is_consistent(pushed, tmp_path):
    path = tmp_path / "trajectory.csv"
    write_trajectory(pushed, path, samples=401)
    rows = [row for row in rows_of(path) if row["phase"] == "near" and row["cn1"]]
    t, x, x_dot = numbers_of(rows, "t"), numbers_of(rows, "x"), numbers_of(rows, "x_dot")
    travelled = np.concatenate([[0.0], np.cumsum((x_dot[1:] + x_dot[:-1]) / 2 * np.diff(t))])
    np.testing.assert_allclose(x, x[0] + travelled, atol=1e-6)
    cn = np.stack([numbers_of(rows, f"cn{k}") for k in range(1, 5)])
    ct = np.stack([numbers_of(rows, f"ct{k}") for k in range(1, 5)])
    np.testing.assert_allclose(np.abs(ct), 0.1 * cn, rtol=1e-9)
    assert cn.min() >= pushed.phases[0].margin - 1e-6 * abs(pushed.phases[0].margin)
    np.testing.assert_array_equal(numbers_of(rows, "tau1"), 0.55)


def numbers_of(rows, name):
    return np.array([float(row[name]) for row in rows])


def test_forces_are_empty_while_friction_holds(still, tmp_path):
    assert still.status is Status.STUCK
    write_trajectory(still, tmp_path / "trajectory.csv", samples=5)
    rows = rows_of(tmp_path / "trajectory.csv")
    assert {row["phase"] for row in rows} == {"near"}
    assert all(row["cn1"] == "" and row["ct4"] == "" for row in rows)
    assert all(float(row["tau1"]) == 0 and float(row["x_dot"]) == 0 for row in rows)


def strict(path):
    """Read JSON as the standard has it: without NaN and infinities."""

    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_summary(pushed, tmp_path):
    path = tmp_path / "summary.json"
    write_summary(summary(pushed, bounds=(1.0, float("-inf")), command="simulate", seconds=float("nan")), path)
    content = strict(path)
    assert content["status"] == "ok"
    assert content["margin"] == pushed.margin
    assert [p["bound"] for p in content["phases"]] == [1.0, None]
    assert content["seconds"] is None
    expected = {"name", "contacts", "status", "duration", "margin", "margin_time", "margin_contact", "bound"}
    for row, phase in zip(content["phases"], pushed.phases, strict=True):
        assert expected <= row.keys()
        assert row["contacts"] == ["palm:v5", "palm:v6", "finger1:v1", "finger2:v3"]
        assert row["margin"] == phase.margin
        assert row["margin_contact"] in row["contacts"]
        assert phase.start <= row["margin_time"] <= phase.start + phase.duration
    again = parse(content["scene"])
    assert eqx.tree_equal(again, pushed.scene)


def test_summary_of_a_failure_is_strict_json(still, tmp_path):
    path = tmp_path / "summary.json"
    write_summary(summary(still), path)
    content = strict(path)
    assert content["status"] == content["phases"][0]["status"] == "stuck"
    assert content["message"].startswith("near: stuck")


# --- whole or not at all ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", ["new", b"\x00new"])
def test_write_whole_replaces_a_file(content, tmp_path):
    path = tmp_path / "file"
    path.write_text("old, and longer")
    write_atomically(path, content)
    assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
    assert os.listdir(tmp_path) == ["file"]


def test_write_whole_moves_a_complete_file_into_place(tmp_path, monkeypatch):
    path, replace, phase_schedule = tmp_path / "file", os.replace, []
    path.write_text("old")

    def watched(source, target):
        phase_schedule.append((path.read_text(), pathlib.Path(source).read_text(), os.path.dirname(source)))
        replace(source, target)

    monkeypatch.setattr(os, "replace", watched)
    write_atomically(path, "new")
    assert phase_schedule == [("old", "new", str(tmp_path))]
    assert path.read_text() == "new"


@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("error", [OSError("full"), KeyboardInterrupt()])
def test_write_whole_leaves_nothing_behind(error, existing, tmp_path, monkeypatch):
    path = tmp_path / "file"
    if existing:
        path.write_text("old")

    def fail(source, target):
        raise error

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(type(error)):
        write_atomically(path, "new")
    assert os.listdir(tmp_path) == (["file"] if existing else [])
    assert not existing or path.read_text() == "old"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
def test_write_whole_keeps_permissions(mode, tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(mode)
    write_atomically(path, "new")
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == mode


def test_write_whole_gives_a_new_file_the_permissions_of_any(tmp_path):
    write_atomically(tmp_path / "ours", "new")
    (tmp_path / "any").write_text("new")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "any").stat().st_mode


def test_write_whole_writes_the_file_behind_a_link(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "file").write_text("old")
    (tmp_path / "link").symlink_to("far/file")
    write_atomically(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "far" / "file").read_text() == "new"
    assert sorted(os.listdir(tmp_path)) == ["far", "link"]


def test_write_whole_onto_a_folder(tmp_path):
    (tmp_path / "file").mkdir()
    with pytest.raises(OSError, match="file"):
        write_atomically(tmp_path / "file", "new")
    assert os.listdir(tmp_path) == ["file"]
