"""The command line: exit status 0 for ok, 1 for a plan that fails, 2 and one line for bad input."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from support import layered, layered_file

from wholearm_jax.cli.output import write_result
from wholearm_jax.files.scene_toml import bundled, to_dict
from wholearm_jax.model.schedule import TorqueSchedule, torque_schedule
from wholearm_jax.phases.plan_simulation import simulate

CHECK = ("--optimise", "--out=x.zarr", "--count", 2)


@pytest.fixture
def zero(tmp_path):
    """A schedule without torque, as long as the heptagon's plan."""
    path = tmp_path / "zero.csv"
    path.write_text("t,tau1,tau2\n0,0,0\n2,0,0\n")
    return path


@pytest.fixture
def scene_file(tmp_path):
    """Write a scene like the heptagon's: changes of its dictionary -> path."""

    def write(change):
        data = to_dict(layered("heptagon"))
        change(data)
        path = tmp_path / "scene.toml"
        path.write_text(tomli_w.dumps(data))
        return path

    return write


def assert_bad_input(answer, *parts):
    """Exit status 2, nothing on standard output, one line on standard error that names everything in `parts`."""
    code, out, err = answer
    assert code == 2
    assert out == ""
    assert err.startswith("wholearm: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    for part in parts:
        assert str(part) in err


# --- what works ------------------------------------------------------------------------------------------------------


def test_scenes(wholearm):
    code, out, err = wholearm("scenes")
    assert code == 0
    rows = out.splitlines()
    assert "heptagon: irregular heptagon; slide right, flip right" in rows
    assert "hexagon: hexagon; slide right, flip right" in rows
    assert [row.partition(":")[0] for row in rows] == list(bundled())
    assert err == ""


def test_help_lists_the_commands(wholearm):
    code, out, _ = wholearm("--help")
    assert code == 0
    for name in ("optimise", "simulate", "search", "report", "formations", "execute", "scenes", "tradeoff"):
        assert f"  {name} " in out
    commands = out.partition("Commands:")[2].strip().splitlines()
    assert len(commands) == 11
    assert all(line.endswith(".") and not line.endswith("...") for line in commands)  # each on one line, as a whole


def test_runs_as_a_program(tmp_path):
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "true"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "wholearm_jax", "search", "heptagn"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "wholearm: heptagn: no such file; did you mean the bundled scene 'heptagon'?\n"
    assert os.listdir(tmp_path) == []


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["optimise", "simulate", "search"])
def test_unknown_scene(name, wholearm, zero, tmp_path):
    more = ["--torque", zero] if name == "simulate" else []
    assert_bad_input(wholearm(name, tmp_path / "none.toml", *more), tmp_path / "none.toml", "no such file")


@pytest.mark.parametrize("name", ["optimise", "simulate", "search"])
def test_bad_scene_file(name, wholearm, zero, scene_file):
    path = scene_file(lambda data: data["object"].update(mass=-1.0))
    more = ["--torque", zero] if name == "simulate" else []
    assert_bad_input(wholearm(name, path, *more), path, "object.mass", "greater than 0")


def test_bad_torque_file(wholearm, tmp_path):
    path = tmp_path / "torque.csv"
    path.write_text("t,tau1,tau2\n0,0,0\n2,much,0\n")
    assert_bad_input(
        wholearm("simulate", layered_file("heptagon"), "--torque", path), path, "line 3", "not three numbers"
    )


def test_missing_torque_file(wholearm, tmp_path):
    path = tmp_path / "torque.csv"
    assert_bad_input(wholearm("simulate", layered_file("heptagon"), "--torque", path), path, "no such file")


@pytest.mark.parametrize("name", ["optimise", "simulate", "search"])
def test_output_folder_that_is_a_file(name, wholearm, zero, tmp_path):
    place = tmp_path / "out"
    place.write_text("in the way")
    more = ["--torque", zero] if name == "simulate" else []
    assert_bad_input(
        wholearm(name, layered_file("heptagon"), "--out", place, *more), "--out", place, "cannot be written"
    )
    assert place.read_text() == "in the way"


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ("slide right.duration=1", "phases: slide left, flip right"),
        ("2.duration=1", "phases: slide left, flip right"),
        ("\u00b2.duration=1", "phases: slide left, flip right"),
        ("slide left.speed=1", "PHASE.duration=SECONDS"),
        ("duration=1", "PHASE.duration=SECONDS"),
        ("slide left.duration", "a positive number of seconds"),
        ("slide left.duration=-1", "a positive number of seconds"),
        ("slide left.duration=0", "a positive number of seconds"),
        ("slide left.duration=nan", "a positive number of seconds"),
        ("0.duration=inf", "a positive number of seconds"),
        ("1.duration=soon", "a positive number of seconds"),
    ],
)
def test_bad_changes(change, cause, wholearm):
    assert_bad_input(wholearm("optimise", layered_file("heptagon"), "--set", change), f"--set {change}: ", cause)


def test_torque_file_shorter_than_the_plan(wholearm, zero):
    answer = wholearm("simulate", layered_file("heptagon"), "--torque", zero, "--set", "1.duration=1.5")
    assert_bad_input(answer, zero, "covers 0 to 2 s, the plan 0 to 2.5 s")


def spread(data):
    data["hand"]["finger1"]["joint"], data["hand"]["finger2"]["joint"] = [1.0, 0.0], [-1.0, 0.0]


def pause(data):
    data["phase"][1] = {"name": "pause", "contacts": data["phase"][0]["contacts"], "hold": True, "duration": 0.5}


def test_the_search_refuses_a_phase_that_holds(wholearm, scene_file):
    path = scene_file(pause)
    assert_bad_input(wholearm("search", path), f"{path}: phase 'pause' holds the object")


def shorten(data):
    data["hand"]["finger1"]["length"] = 0.02


def overload(data):
    data["phase"][0]["contacts"] = ["palm:v5", "palm:v6", "palm:v0", "finger2:v3"]


def skip(data):
    data["phase"][1]["contacts"] = ["palm:v6", "finger1:v0", "finger2:v3", "finger2:v4"]


def stop_early(data):
    data["phase"][0]["until"] = {"x": 0.0}


@pytest.mark.parametrize(
    ("change", "key", "contact", "cause"),
    [
        (spread, "phase[0].contacts", "finger2:v3", "from this start"),
        (shorten, "phase[0].contacts", "finger1:v1", "a gap of 0.0504 m stays open"),
        (overload, "phase[0].contacts", "palm:v", "from this start"),  # any of three vertices on a flat palm
        (skip, "phase[1].contacts", "finger1:v0", "where phase 'slide left' ends"),
        (stop_early, "phase[1].contacts", "finger2:v4", "where phase 'slide left' ends"),
    ],
)
def test_contacts_that_cannot_all_touch(change, key, contact, cause, wholearm, zero, scene_file):
    path = scene_file(change)
    answer = wholearm("simulate", path, "--torque", zero)
    assert_bad_input(answer, f"{path}: {key}: {contact}", "cannot touch", cause, "stays open")


@pytest.mark.parametrize("option", [("--rate-limit", 0.5), ("--passing", 0.5)])
def test_what_robust_does_not_know(option, wholearm, tmp_path):
    answer = wholearm("optimise", layered_file("heptagon"), "--robust", "friction=20%", *option, "--out", tmp_path)
    assert_bad_input(answer, f"--robust: knows no {option[0]}")


def test_robust_knows_no_holds(wholearm, scene_file):
    path = scene_file(lambda data: data["phase"][1].update(name="wait", hold=True) or data["phase"][1].pop("toward"))
    answer = wholearm("optimise", path, "--robust", "friction=20%")
    assert_bad_input(answer, "--robust: phase 'wait' holds the object")


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (("optimise", "heptagon", "--knots", 2), "'--knots'"),
        (("optimise", "heptagon", "--rate-limit", 0), "'--rate-limit'"),
        (("simulate", "heptagon"), "'--torque'"),
        (("optimise",), "'scene'"),
        (("optimize", "heptagon"), "'optimize'"),
        (("scenes", "--all"), "--all"),
        (("optimise", "heptagon", "--robust", "mass=5%", "--robust", "mass=1%"), "mass=5%, mass=1%: mass stands twice"),
        (("plan", "heptagon", "--goal", "x=0.01,x=0.02"), "--goal x=0.01,x=0.02: x stands twice"),
        (("plan", "heptagon", "--by", "phi=-1", "--tolerance", "phi=0"), "tolerances positive"),
        (("check", "heptagon", *CHECK, "--vary", "friction=20"), "a percentage is written 20%"),
        (("check", "heptagon", "--torque", __file__, "--polygons", __file__, "--out", "x.zarr"), "missing column"),
        (("check", "heptagon", "--optimise", "--polygons", __file__, "--out", "x.zarr"), "file of numbers"),
        (("check", "heptagon", *CHECK[2:], "--optimise", "--vary", "mass=1%", "--out", __file__), "is not a store"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, cause, wholearm):
    assert_bad_input(wholearm(*arguments), cause)


@pytest.mark.parametrize("name", ["optimise", "search"])
def test_contacts_that_cannot_all_touch_stop_every_command(name, wholearm, scene_file):
    path = scene_file(spread)
    assert_bad_input(wholearm(name, path), f"{path}: phase[0].contacts: finger2:v3 cannot touch", "stays open")


# --- plans that fail -------------------------------------------------------------------------------------------------


def test_plan_that_fails(wholearm, zero, tmp_path):
    out = tmp_path / "some" / "where"
    code, printed, err = wholearm("simulate", layered_file("heptagon"), "--torque", zero, "--out", out, "--samples", 5)
    assert code == 1
    assert err == ""
    assert printed.startswith("slide left: stuck, t = 1 s, at rest since 0 s: ")
    assert "of it reached" not in printed
    assert {"torque.csv", "trajectory.csv", "summary.json", "plan.png", "result.svg"} <= set(os.listdir(out))
    assert not [name for name in os.listdir(out) if name.startswith(".")]
    content = json.loads((out / "summary.json").read_text())
    assert content["status"] == "stuck"
    assert content["command"] == "simulate"
    assert [p["name"] for p in content["phases"]] == ["slide left", "flip right"]
    assert [p["bound"] for p in content["phases"]] == pytest.approx([0.966, 0.835], abs=1e-3)


def test_path_that_cannot_be_followed(wholearm, zero, scene_file, tmp_path):
    path = scene_file(lambda data: data["phase"][0].update(toward="phi+"))  # the object slides without turning
    code, printed, err = wholearm("simulate", path, "--torque", zero, "--out", tmp_path / "out")
    assert code == 1
    assert err == ""
    assert printed.startswith("slide left: singular")
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["margin"] is None


def test_how_exact_torques_must_be_is_said(wholearm, tmp_path):
    """In a note where a motor's error is too much, and in the summary of each phase."""
    torque = Path(__file__).parents[1] / "data" / "heptagon_torque.csv"
    code, _, err = wholearm("simulate", layered_file("heptagon"), "--torque", torque, "--out", tmp_path, "--samples", 5)
    assert code == 0
    phases = json.loads((tmp_path / "summary.json").read_text())["phases"]
    least = min(phase["torque_accuracy"] for phase in phases)
    assert 1e-4 < least < 1e-2
    assert f"torques must be right to {100 * least:.2g} % for an end within 0.5 mm and 0.01 rad" in err


# --- what may not be meant -------------------------------------------------------------------------------------------


def test_torques_beyond_a_limit_are_noted(wholearm, scene_file, tmp_path):
    path, torque = scene_file(lambda data: data["hand"]["finger2"].update(torque_limit=0.25)), tmp_path / "much.csv"
    torque.write_text("t,tau1,tau2\n0,0.3,0\n0.5,0.3,-0.4\n2,0.3,0\n")
    _, _, err = wholearm("simulate", path, "--torque", torque)
    assert err == f"wholearm: note: {torque}: |tau2| is 0.4 N m at t = 0.5 s, beyond the limit of 0.25 N m\n"


def test_an_until_that_is_not_on_the_path_is_noted(wholearm, zero, scene_file):
    path = scene_file(lambda data: data["phase"][0].update(until={"x": 5.0}))
    _, _, err = wholearm("simulate", path, "--torque", zero)
    assert err.startswith(f"wholearm: note: {path}: phase[0].until: x = 5 is not on its path, which leads from ")
    path = scene_file(lambda data: data.update(phase=[data["phase"][0] | {"until": {"x": 0.01}}]))
    assert wholearm("simulate", path, "--torque", zero)[2] == ""


@pytest.mark.parametrize("record", ["ok", "stuck"])
def test_a_plan_that_fails_does_not_take_the_place_of_one_that_is_ok(record, wholearm, zero, tmp_path):
    for name, text in (("torque.csv", "old"), ("report.html", "old"), ("summary.json", f'{{"status": "{record}"}}')):
        (tmp_path / name).write_text(text)
    code, out, err = wholearm("simulate", layered_file("heptagon"), "--torque", zero, "--out", tmp_path)
    assert code == 1
    stays = (tmp_path / "report.html").exists() and (tmp_path / "torque.csv").read_text() == "old"
    assert stays == (record == "ok")
    assert ("the result there is ok and stays" in err) == stays
    assert (f"-> {tmp_path}" in out) != stays


def test_a_result_without_torques_is_not_written(tmp_path, capsys):
    """As of phases that are too fast for the torques."""
    scene = layered("heptagon")
    plan = simulate(scene, torque_schedule([0.0, 2.0], np.zeros((2, 2))))
    undefined = dataclasses.replace(plan, torque=TorqueSchedule(plan.torque.times, plan.torque.values * np.nan))
    write_result(undefined, tmp_path, 5, as_json=False)
    assert list(tmp_path.iterdir()) == []
    assert "no torques were found; nothing is written" in capsys.readouterr().err


def test_nothing_of_an_earlier_result_stays_in_a_folder(wholearm, zero, tmp_path):
    for name in ("report.html", "plan.png", "mine.txt"):
        (tmp_path / name).write_text("of another time")
    wholearm("simulate", layered_file("heptagon"), "--torque", zero, "--out", tmp_path)
    assert not (tmp_path / "report.html").exists()
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "mine.txt").exists()
