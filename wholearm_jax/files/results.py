"""Result files: torque schedules and trajectories as CSV, summaries as JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wholearm_jax.core import SceneError, write_atomically
from wholearm_jax.files.scene_toml import CONSTRAINTS, to_dict
from wholearm_jax.model import COORDINATES, TorqueSchedule, torque_schedule
from wholearm_jax.phases import Result, trajectory

if TYPE_CHECKING:  # running them needs MuJoCo, writing does not
    from wholearm_jax.execution import Execution, TrialsResult

TORQUE_COLUMNS = ("t", "tau1", "tau2")
_CONTACTS = range(1, CONSTRAINTS + 1)
TRAJECTORY_COLUMNS = (
    *("t", "phase", *COORDINATES, *(f"{c}_dot" for c in COORDINATES), "tau1", "tau2"),
    *(f"cn{k}" for k in _CONTACTS),
    *(f"ct{k}" for k in _CONTACTS),
)


def read_torque(path: str | Path) -> TorqueSchedule:
    """Read a torque schedule (header `t,tau1,tau2`; s, N m).

    Raises `SceneError` naming the file, the line and the cause.

    >>> wa.write_torque(wa.torque_schedule([0.0, 2.0], [[0.5, -0.2], [0.5, -0.4]]), folder / "torque.csv")
    >>> wa.read_torque(folder / "torque.csv").values.tolist()
    [[0.5, -0.2], [0.5, -0.4]]
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SceneError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not rows:
        raise SceneError(f"{path}: line 1: the file is empty; it needs the header t,tau1,tau2 and at least two rows")
    header = [name.strip() for name in rows[0]]
    missing = [name for name in TORQUE_COLUMNS if name not in header]
    if missing:
        raise SceneError(f"{path}: line 1: missing column {', '.join(missing)}; the header is t,tau1,tau2")
    places = [header.index(name) for name in TORQUE_COLUMNS]
    numbers = []
    for line, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            values = [float(row[place]) for place in places]
        except (ValueError, IndexError):
            raise SceneError(f"{path}: line {line}: not three numbers: {','.join(row)!r:.60}") from None
        if not all(map(math.isfinite, values)):
            raise SceneError(f"{path}: line {line}: not finite: {','.join(row)!r:.60}")
        if numbers and values[0] < numbers[-1][0]:
            last = numbers[-1][0]
            raise SceneError(f"{path}: line {line}: t = {values[0]:g} follows {last:g}: times must not decrease")
        if len(numbers) > 1 and values[0] == numbers[-2][0]:
            raise SceneError(f"{path}: line {line}: t = {values[0]:g} stands a third time; twice is a step")
        numbers.append(values)
    table = np.asarray(numbers).reshape(-1, 3)
    try:
        return torque_schedule(table[:, 0], table[:, 1:])
    except ValueError as error:
        raise SceneError(f"{path}: line {len(rows)}: the file ends here: {error}") from None


def write_torque(schedule: TorqueSchedule, path: str | Path) -> None:
    """Write a torque schedule (header `t,tau1,tau2`; s, N m) with every digit. Raises `OSError`.

    >>> wa.write_torque(wa.torque_schedule([0.0, 2.0], [[0.5, -0.2], [0.5, -0.4]]), folder / "torque.csv")
    >>> print((folder / "torque.csv").read_text(), end="")
    t,tau1,tau2
    0.0,0.5,-0.2
    2.0,0.5,-0.4
    """
    table = np.column_stack([np.asarray(schedule.times), np.asarray(schedule.values)])
    write_atomically(path, _csv(TORQUE_COLUMNS, table.tolist()))


def write_trajectory(result: Result, path: str | Path, samples: int = 201) -> None:
    """Write every phase at `samples` times; forces are empty where friction holds the object at rest."""
    rows = []
    for phase, course in zip(result.phases, trajectory(result, samples), strict=False):
        blocks = (course.z, course.z_dot, course.torque, course.cn, course.ct)
        for k, time in enumerate(np.asarray(course.time)):
            numbers = [v for block in blocks for v in np.asarray(block)[k].tolist()]
            rows.append([float(time), phase.name, *("" if math.isnan(v) else v for v in numbers)])
    write_atomically(path, _csv(TRAJECTORY_COLUMNS, rows))


def summary(result: Result, *, bounds: tuple[float, ...] | None = None, **more: Any) -> dict[str, Any]:
    """What became of a plan, as the summary file holds it, with the scene to run it again."""
    phases = []
    for k, phase in enumerate(result.phases):
        row = {
            "name": phase.name,
            "contacts": list(phase.contacts),
            "status": phase.status.label,
            "time": phase.time,
            "contact": phase.contact,
            "duration": phase.duration,
            "margin": phase.margin,
            "margin_time": phase.margin_time,
            "margin_contact": phase.margin_contact,
            "bound": None if bounds is None else bounds[k],
            "holds": [_plain(held._asdict()) for held in phase.holds],
            "message": phase.message,
        }
        phases.append(_plain(row))
    head = {"status": result.status.label, "margin": result.margin, "hold_margin": result.hold_margin}
    head["message"] = result.message
    again = {"scene": to_dict(result.scene), "version": version("wholearm_jax")}
    return _plain(head) | {"phases": phases} | _plain(more) | again


def execution_summary(execution: Execution, robustness: TrialsResult | None = None, **more: Any) -> dict[str, Any]:
    """What became of an execution, and of its perturbed copies, as the file `execution.json` holds it."""
    head = {"status": execution.ending.value, "message": execution.message}
    errors = {
        "position_error": execution.position_error,
        "angle_error": execution.angle_error,
        "creep": execution.creep,
    }
    within = {"tolerance": _plain(execution.tolerance._asdict()), "open_at_end": list(execution.open_at_end)}
    events = [event._asdict() for event in execution.events]
    prediction = {"status": execution.prediction.status.label, "margin": execution.prediction.margin}
    row = _plain(head | errors) | within | {"events": events, "prediction": _plain(prediction)}
    if robustness is not None:
        low, high = robustness.interval
        row["perturbed"] = {
            "amounts": _plain(robustness.amounts._asdict()),
            "seed": robustness.seed,
            "executions": len(robustness.runs),
            "successes": robustness.successes,
            "interval_95": [low, high],
            "runs": [_perturbed_row(run) for run in robustness.runs],
        }
    return row | {"timestep": execution.timestep} | _plain(more) | {"scene": to_dict(execution.prediction.scene)}


def _perturbed_row(run) -> dict[str, Any]:
    drawn = {"friction": run.friction.tolist(), "mass": run.mass}
    end = [value if math.isfinite(value) else None for value in run.end.tolist()]
    errors = {"position_error": run.position_error, "angle_error": run.angle_error}
    return drawn | {"status": run.ending.value} | _plain(errors) | {"end": end}


def write_execution(execution: Execution, path: str | Path, samples: int = 201) -> None:
    """Write an execution at about `samples` times a phase: `t`, `z`, its rates, and `c_n` of every planned contact."""
    course, planned = execution.course, execution.planned
    every = max(1, (len(course.time) - 1) // (samples * len(execution.prediction.phases)))
    columns = [execution.names.index(name) for name in planned]
    table = np.column_stack([course.time, course.z, course.z_dot, course.cn[:, columns]])[::every]
    header = ("t", *COORDINATES, *(f"{c}_dot" for c in COORDINATES), *(f"cn {name}" for name in planned))
    write_atomically(path, _csv(header, table.tolist()))


def discard(folder: Path) -> None:
    """Remove what an earlier result left in a folder: files of two results beside each other would mislead."""
    _remove(folder, ("torque.csv", "trajectory.csv", "summary.json", "report.html"), ("plan", "result"))


def discard_execution(folder: Path) -> None:
    """The same for what an earlier execution left."""
    _remove(folder, ("execution.json", "execution.csv", "execution.gif", "model.xml"), ("execution", "frames"))


def _remove(folder: Path, files: tuple[str, ...], figures: tuple[str, ...]) -> None:
    for name in (*files, *(f"{figure}.{kind}" for figure in figures for kind in ("png", "svg", "pdf"))):
        (folder / name).unlink(missing_ok=True)


def write_summary(content: dict[str, Any], path: str | Path) -> None:
    """Write a summary as JSON."""
    write_atomically(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinity and no NaN: what is undefined is null."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def _csv(header, rows) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()
