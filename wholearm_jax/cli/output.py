"""What the commands that simulate a plan write and say at their end."""

import sys
from functools import partial
from pathlib import Path

from wholearm_jax.cli.arguments import writing


def finish(result, folder: Path | None, samples: int, report: bool = False, **more) -> None:
    """Write the files, say what became of the plan, and exit with its status."""
    write_result(result, folder, samples, report, **more)
    sys.exit(0 if result.status.value == 0 else 1)


def write_result(result, folder: Path | None, samples: int, report: bool = False, **more) -> None:
    """Write the files, in place of those of an earlier result, and say what became of the plan."""
    if folder is not None:
        from wholearm_jax.files import discard, summary, write_summary, write_torque, write_trajectory

        with writing(f"--out {folder}"):
            discard(folder)
            write_torque(result.torque, folder / "torque.csv")
            write_trajectory(result, folder / "trajectory.csv", samples)
            write_summary(summary(result, **more), folder / "summary.json")
            _draw(result, folder)
            if report:
                write_report(folder, folder / "report.html")
    print(result.message if not folder else f"{result.message} -> {folder}")


def write_report(folder: Path, path: Path) -> None:
    """Write a result folder's page."""
    from wholearm_jax.core import write_atomically
    from wholearm_jax.report import report as page

    write_atomically(path, page(folder))


def _draw(result, folder: Path) -> None:
    from wholearm_jax.phases import trajectory
    from wholearm_jax.plotting import draw_result, draw_strip, save_figure

    figures = {"plan": draw_strip, "result": draw_result} if trajectory(result) else {}  # no motion, nothing to draw
    for name, draw in figures.items():
        save_figure(partial(draw, result), folder, name)
