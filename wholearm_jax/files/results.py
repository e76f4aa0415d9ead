"""Result files: torque schedules and trajectories as CSV, summaries as JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from wholearm_jax.core import SceneError, write_atomically
from wholearm_jax.files.scene_toml import CONSTRAINTS, to_dict
from wholearm_jax.model import COORDINATES, TorqueSchedule, torque_schedule
from wholearm_jax.phases import Result, trajectory

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
    """Write a torque schedule (header `t,tau1,tau2`; s, N m) with every digit.

    Raises:
        OSError: the file cannot be written.
        ValueError: a number of the schedule is not finite.

    >>> wa.write_torque(wa.torque_schedule([0.0, 2.0], [[0.5, -0.2], [0.5, -0.4]]), folder / "torque.csv")
    >>> print((folder / "torque.csv").read_text(), end="")
    t,tau1,tau2
    0.0,0.5,-0.2
    2.0,0.5,-0.4
    """
    table = np.column_stack([np.asarray(schedule.times), np.asarray(schedule.values)])
    if not np.isfinite(table).all():
        row = int(np.argmin(np.isfinite(table).all(axis=1)))
        raise ValueError(f"a schedule with a number that is not finite, in row {row}, cannot be written")
    write_atomically(path, csv_text(TORQUE_COLUMNS, table.tolist()))


def write_trajectory(result: Result, path: str | Path, samples: int = 201) -> None:
    """Write every phase at `samples` times; forces are empty where friction holds the object at rest."""
    rows = []
    for phase, motion in zip(result.phases, trajectory(result, samples), strict=False):
        blocks = (motion.z, motion.z_dot, motion.torque, motion.cn, motion.ct)
        for k, time in enumerate(np.asarray(motion.time)):
            rows.append([float(time), phase.name, *(v for block in blocks for v in np.asarray(block)[k].tolist())])
    write_atomically(path, csv_text(TRAJECTORY_COLUMNS, rows))


def summary(result: Result, *, bounds: tuple[float, ...] | None = None, **more: Any) -> dict[str, Any]:
    """Return the content of `summary.json`: the result of each phase and of the plan, and the scene to run it again.

    Args:
        result: of the plan.
        bounds: of each phase's margin [N].
        more: further entries, such as the command and its settings.
    """
    phases = [
        {
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
            "holds": [rest._asdict() for rest in phase.holds],
            "message": phase.message,
        }
        for k, phase in enumerate(result.phases)
    ]
    head = {"status": result.status.label, "margin": result.margin, "hold_margin": result.hold_margin}
    tail = {"scene": to_dict(result.scene), "version": version("wholearm_jax")}
    return null_for_undefined(head | {"message": result.message, "phases": phases} | more | tail)


def write_summary(content: dict[str, Any], path: str | Path) -> None:
    """Write a summary as JSON."""
    write_atomically(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def null_for_undefined(content: Any) -> Any:
    """Return lists and dictionaries with None for NaN and infinity, which JSON does not have."""
    if isinstance(content, dict):
        return {key: null_for_undefined(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [null_for_undefined(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as CSV; cells of undefined numbers are empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow(["" if isinstance(v, float) and not math.isfinite(v) else v for v in row])
    return buffer.getvalue()
