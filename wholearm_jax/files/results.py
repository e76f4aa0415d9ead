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

from wholearm_jax.core import Status, write_atomically
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.files.torque_csv import TORQUE_COLUMNS
from wholearm_jax.model import CONSTRAINTS, COORDINATES, TorqueSchedule
from wholearm_jax.phases import Result, torque_accuracy, trajectory

_CONTACTS = range(1, CONSTRAINTS + 1)
TRAJECTORY_COLUMNS = (
    *("t", "phase", *COORDINATES, *(f"{c}_dot" for c in COORDINATES), "tau1", "tau2"),
    *(f"cn{k}" for k in _CONTACTS),
    *(f"ct{k}" for k in _CONTACTS),
)


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
    accuracy = torque_accuracy(result) if result.status is Status.OK else [None] * len(result.phases)
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
            "torque_accuracy": accuracy[k],
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
