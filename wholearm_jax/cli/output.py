"""Output of the commands that simulate a plan: files, figures, the last line and the exit status."""

import sys
from functools import partial
from pathlib import Path
from typing import NoReturn

from wholearm_jax.cli.arguments import note, refuse_unwritable


def print_phases(result) -> None:
    """Print a line for each phase, and for each interval in which friction holds the object at rest."""
    for phase in result.phases:
        print(phase.message)
        for rest in phase.holds:
            print(f"    {rest.message}")


def write_and_exit(result, folder: Path | None, samples: int, as_json: bool, report: bool = False, **more) -> NoReturn:
    """Write the files, print the result's message or the summary, and exit with its status."""
    write_result(result, folder, samples, as_json, report, **more)
    sys.exit(0 if result.status.value == 0 else 1)


def write_result(
    result,
    folder: Path | None,
    samples: int,
    as_json: bool,
    report: bool = False,
    controller=None,
    law_is_asked_for: bool = False,
    **more,
) -> None:
    """Write the files in place of those of an earlier result, and print the result's message or the summary.

    A result without torques is not written, and one that is not `ok` not over one that is: notes say so. Another says
    what torques must be like open loop, unless a law is asked for (`controller`, None where there is none).
    """
    import numpy as np

    from wholearm_jax.cli.tables import print_json
    from wholearm_jax.files import RESULT_FILES, summary

    content = summary(result, **more)
    if folder is not None and not np.isfinite(result.torque.values).all():
        note(f"--out {folder}: no torques were found; nothing is written")
        folder = None
    elif folder is not None and not may_replace(folder, RESULT_FILES, result.status.value == 0):
        folder = None
    if folder is not None:
        _write_files(result, content, folder, samples, report, controller)
    if as_json:
        print_json(content)
    else:
        print(result.message if not folder else f"{result.message} -> {folder}")
        if not law_is_asked_for:
            _note_accuracy(content)
            note_hand_overs(result)


def _note_accuracy(content: dict) -> None:
    """Say how exact torques must be, where a motor's usual error is too much, and what helps."""
    from wholearm_jax.phases import END_ANGLE, END_POSITION, MOTOR_ERROR

    known = [phase["torque_accuracy"] for phase in content["phases"] if phase["torque_accuracy"] is not None]
    if known and min(known) < MOTOR_ERROR:
        note(
            f"open loop, torques must be right to {100 * min(known):.2g} % for an end within {1e3 * END_POSITION:g} mm"
            f" and {END_ANGLE:g} rad; a law corrects what is wrong: wholearm optimise SCENE --feedback"
        )


def note_hand_overs(result) -> None:
    """Say where torques hold an object at a hand-over by the planned contact alone, and what helps."""
    from wholearm_jax.phases import one_sided_torques

    for one in one_sided_torques(result):
        moves, comes = ("stop", "early") if one.stops else ("start", "late")
        ends = "contacts are lost" if one.force < 0 else "it does not stop"
        note(
            f"open loop, the torques that {moves} the object at {one.time:.4g} s do so by {one.planned} alone: if it"
            f" comes there a moment {comes}, {one.other} holds it, and {ends}; a law does for both:"
            " wholearm optimise SCENE --feedback"
        )


def may_replace(folder: Path, files, ok: bool) -> bool:
    """Return whether a result may take the place of what a folder holds: one that is not ok not of one that is."""
    from wholearm_jax.files import is_ok

    if ok or not is_ok(folder, files):
        return True
    note(f"--out {folder}: the result there is ok and stays; this one is not, and is not written")
    return False


def _write_files(result, content: dict, folder: Path, samples: int, report: bool, controller) -> None:
    """Write the files of a result and its figures."""
    from wholearm_jax.files import (
        RESULT_FILES,
        replace_files,
        write_controller,
        write_summary,
        write_torque,
        write_trajectory,
    )

    with refuse_unwritable(f"--out {folder}"), replace_files(folder, RESULT_FILES) as scratch:
        write_torque(result.torque, scratch / "torque.csv")
        write_trajectory(result, scratch / "trajectory.csv", samples)
        write_summary(content, scratch / "summary.json")
        if controller is not None:
            write_controller(controller, scratch / "controller.json")
        _write_figures(result, scratch)
        if report:
            write_report(scratch, scratch / "report.html")


def write_report(folder: Path, path: Path) -> None:
    """Write the page of a result folder."""
    from wholearm_jax.core import write_atomically
    from wholearm_jax.report import report

    write_atomically(path, report(folder))


def _write_figures(result, folder: Path) -> None:
    """Write the figures of a plan that moves."""
    from wholearm_jax.phases import trajectory
    from wholearm_jax.plotting import plot_result, plot_strip, save_figure

    figures = {"plan": plot_strip, "result": plot_result} if trajectory(result) else {}
    for name, plot in figures.items():
        save_figure(partial(plot, result), folder, name)
