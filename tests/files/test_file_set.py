"""Files as a set: replaced together or not at all; what is undefined is no number."""

import json
import os

import numpy as np
import pytest

from wholearm_jax.core.atomic_files import write_together
from wholearm_jax.files.file_set import RESULT_FILES, is_ok, replace_files
from wholearm_jax.files.results import csv_text, null_for_undefined, write_torque
from wholearm_jax.model.schedule import TorqueSchedule

EARLIER = {
    "torque.csv": "old",
    "report.html": "old",
    "plan.png": "old",
    "summary.json": '{"status": "ok"}',
    "mine": "m",
}


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path):
    """A folder with an earlier result, and a file of the user's."""
    for name, text in EARLIER.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def test_a_set_takes_the_place_of_the_earlier_one(folder):
    with replace_files(folder, RESULT_FILES) as scratch:
        for name in ("torque.csv", "summary.json"):
            (scratch / name).write_text("new")
        assert contents(folder) == EARLIER
    assert contents(folder) == {"torque.csv": "new", "summary.json": "new", "mine": "m"}


@pytest.mark.parametrize("error", [OSError("full"), ValueError("NaN"), KeyboardInterrupt()])
def test_a_set_that_fails_leaves_the_earlier_one(error, folder):
    def write(scratch):
        (scratch / "torque.csv").write_text("new")
        raise error

    with pytest.raises(type(error)), replace_files(folder, RESULT_FILES) as scratch:
        write(scratch)
    assert contents(folder) == EARLIER


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_disk_that_fills_up_leaves_the_earlier_set(number, folder, monkeypatch):
    """Whichever file it is that cannot be written any more."""
    opened, count = open, 0

    def full(path, mode="r", *rest, **more):
        nonlocal count
        count += "x" in mode
        if count == number:
            raise OSError(28, "No space left on device")
        return opened(path, mode, *rest, **more)

    monkeypatch.setattr("builtins.open", full)
    with pytest.raises(OSError, match="No space"):
        write_together(folder, dict.fromkeys(("torque.csv", "plan.png", "summary.json"), "new"), "summary.json")
    monkeypatch.undo()
    assert contents(folder) == EARLIER


def test_a_folder_in_the_way_leaves_the_earlier_set(folder):
    (folder / "result.svg").mkdir()
    with pytest.raises(OSError, match=r"result\.svg"):
        write_together(folder, {"torque.csv": "new", "result.svg": "new", "summary.json": "new"}, "summary.json")
    (folder / "result.svg").rmdir()
    assert contents(folder) == EARLIER


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_set_cut_off_while_it_is_moved_has_no_record(moved, folder, monkeypatch):
    replace, count = os.replace, 0

    def cut_off(source, target):
        nonlocal count
        if count == moved:
            raise KeyboardInterrupt
        count += 1
        replace(source, target)

    monkeypatch.setattr(os, "replace", cut_off)
    with pytest.raises(KeyboardInterrupt):
        write_together(folder, dict.fromkeys(("torque.csv", "plan.png", "summary.json"), "new"), "summary.json")
    assert set(contents(folder)) == set(EARLIER) - {"summary.json"}


@pytest.mark.parametrize(
    ("record", "ok"),
    [('{"status": "ok"}', True), ('{"status": "stuck"}', False), ("{", False), ("[1]", False), (None, False)],
)
def test_which_sets_are_ok(record, ok, tmp_path):
    if record is not None:
        (tmp_path / "summary.json").write_text(record)
    assert is_ok(tmp_path, RESULT_FILES) is ok


def test_what_is_undefined_is_null_or_empty():
    undefined = {"a": [float("nan"), {"b": (float("inf"), 1.0)}], "c": 2, "d": "nan", "e": None}
    assert null_for_undefined(undefined) == {"a": [None, {"b": [None, 1.0]}], "c": 2, "d": "nan", "e": None}
    json.dumps(null_for_undefined(undefined), allow_nan=False)
    assert csv_text(("t", "x"), [[0.0, float("nan")], [float("-inf"), 1]]) == "t,x\n0.0,\n,1\n"


def test_a_schedule_that_is_not_finite_is_not_written(tmp_path):
    schedule = TorqueSchedule(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [np.nan, 0.0]]))
    with pytest.raises(ValueError, match="row 1"):
        write_torque(schedule, tmp_path / "torque.csv")
    assert os.listdir(tmp_path) == []
