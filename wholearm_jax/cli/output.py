"""Output of the commands that simulate a plan: files, figures, the last line and the exit status."""

import sys
from functools import partial
from pathlib import Path

from wholearm_jax.cli.arguments import refuse_unwritable


def print_phases(result) -> None:
    """Print a line for each phase, and for each interval in which friction holds the object at rest."""
    for phase in result.phases:
        print(phase.message)
        for rest in phase.holds:
            print(f"    {rest.message}")


def write_and_exit(result, folder: Path | None, samples: int, report: bool = False, **more) -> None:
    """Write the files, print the result's message, and exit with its status."""
    write_result(result, folder, samples, report, **more)
    sys.exit(0 if result.status.value == 0 else 1)


def write_result(result, folder: Path | None, samples: int, report: bool = False, **more) -> None:
    """Write the files in place of those of an earlier result, and print the result's message."""
    if folder is not None:
        from wholearm_jax.files import discard, summary, write_summary, write_torque, write_trajectory

        with refuse_unwritable(f"--out {folder}"):
            discard(folder)
            write_torque(result.torque, folder / "torque.csv")
            write_trajectory(result, folder / "trajectory.csv", samples)
            write_summary(summary(result, **more), folder / "summary.json")
            _write_figures(result, folder)
            if report:
                write_report(folder, folder / "report.html")
    print(result.message if not folder else f"{result.message} -> {folder}")


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
