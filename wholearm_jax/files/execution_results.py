"""Files of executions: their course as CSV, what became of them and of perturbed copies as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wholearm_jax.core import write_atomically
from wholearm_jax.files.results import csv_text, null_for_undefined
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.model import COORDINATES

if TYPE_CHECKING:  # running executions needs MuJoCo, writing them does not
    from wholearm_jax.execution import Execution, PerturbedRun, TrialsResult


def execution_summary(execution: Execution, trials: TrialsResult | None = None, **more: Any) -> dict[str, Any]:
    """Return the content of `execution.json`: the outcome of an execution and of its perturbed copies.

    Args:
        execution: of the nominal object.
        trials: of perturbed objects.
        more: further entries, such as the torque file.
    """
    prediction = {"status": execution.prediction.status.label, "margin": execution.prediction.margin}
    row = {
        "status": execution.ending.value,
        "message": execution.message,
        "position_error": execution.position_error,
        "angle_error": execution.angle_error,
        "creep": execution.creep,
        "tolerance": execution.tolerance._asdict(),
        "open_at_end": list(execution.open_at_end),
        "link_contacts": execution.link_contacts,
        "events": [event._asdict() for event in execution.events],
        "prediction": prediction,
    }
    if trials is not None:
        row["perturbed"] = {
            "amounts": trials.amounts._asdict(),
            "seed": trials.seed,
            "executions": len(trials.runs),
            "successes": trials.successes,
            "own_path_successes": trials.own_successes,
            "interval_95": list(trials.interval),
            "runs": [_perturbed_row(run) for run in trials.runs],
        }
    tail = {"timestep": execution.timestep} | more | {"scene": to_dict(execution.prediction.scene)}
    return null_for_undefined(row | tail)


def _perturbed_row(run: PerturbedRun) -> dict[str, Any]:
    """Return the outcome of one perturbed execution."""
    row = {
        "friction": run.friction.tolist(),
        "mass": run.mass,
        "status": run.ending.value,
        "position_error": run.position_error,
        "angle_error": run.angle_error,
        "end": run.end.tolist(),
        "own_path_status": run.own_ending.value,
        "own_path_end": None if run.own_target is None else run.own_target.tolist(),
        "least_force": run.least_force,
    }
    return null_for_undefined(row)


def write_execution(execution: Execution, path: str | Path, samples: int = 201) -> None:
    """Write an execution at about `samples` times a phase: `t`, `z`, its rates, and `c_n` of every planned contact."""
    motion, planned = execution.course, execution.planned
    stride = max(1, (len(motion.time) - 1) // (samples * len(execution.prediction.phases)))
    columns = [execution.names.index(name) for name in planned]
    table = np.column_stack([motion.time, motion.z, motion.z_dot, motion.cn[:, columns]])[::stride]
    header = ("t", *COORDINATES, *(f"{c}_dot" for c in COORDINATES), *(f"cn {name}" for name in planned))
    write_atomically(path, csv_text(header, table.tolist()))
