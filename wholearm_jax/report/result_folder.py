"""Result folders as a page needs them: read, and checked against what this library writes."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from wholearm_jax.core import SceneError, Status
from wholearm_jax.core.errors import BadInput
from wholearm_jax.files import (
    TRAJECTORY_COLUMNS,
    Positive,
    controller_to_dict,
    explain_validation_error,
    parse,
    read_controller,
    read_torque,
)
from wholearm_jax.model import Scene, TorqueSchedule


def _label(status: str) -> str:
    if status.upper() not in Status.__members__:
        raise ValueError(f"'{status:.40}' is unknown")
    return status


Label = Annotated[str, AfterValidator(_label)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)] | None


class _PhaseRow(BaseModel):
    """A phase's row of a summary, as far as a page needs it."""

    name: str
    contacts: list[str]
    status: Label
    duration: Positive
    margin: Number
    margin_time: Number
    margin_contact: str | None
    bound: Number


class _Summary(BaseModel):
    """A summary, as far as a page needs it."""

    status: Label
    margin: Number
    message: str
    phases: list[_PhaseRow]
    scene: dict[str, Any]


class ResultFolder(NamedTuple):
    """A result as its folder holds it."""

    summary: dict[str, Any]
    scene: Scene
    torque: TorqueSchedule
    trajectories: dict[str, np.ndarray]  # phase name -> (samples, 1 + numbers of a row): time, then TRAJECTORY_COLUMNS'
    controller: dict[str, Any] | None = None  # the closed-loop law as its file says it, if the folder holds one


def load_result_folder(folder: str | Path) -> ResultFolder:
    """Read `summary.json`, `trajectory.csv`, `torque.csv` and, if there is one, `controller.json`.

    Raises:
        SceneError: naming the file and what is wrong with it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder")
    summary = _read_summary(folder / "summary.json")
    scene = parse(summary["scene"], source=f"{folder / 'summary.json'}: scene")
    names = [phase["name"] for phase in summary["phases"]]
    if names != [phase.name for phase in scene.phases]:
        raise SceneError(f"{folder / 'summary.json'}: phases are not those of its scene")
    trajectories = _read_trajectory(folder / "trajectory.csv", names)
    return ResultFolder(summary, scene, read_torque(folder / "torque.csv"), trajectories, _read_law(folder, names))


def critical_phase(summary: dict[str, Any]) -> dict[str, Any] | None:
    """Return the row of the phase whose margin is the plan's (`Result.critical_phase`); None if one has no margin."""
    pairs = zip(summary["phases"], summary["scene"]["phase"], strict=True)
    rows = [row for row, phase in pairs if not phase.get("hold")] or summary["phases"]
    return None if any(row["margin"] is None for row in rows) else min(rows, key=lambda row: row["margin"])


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file; optimise, simulate and search write it with --out") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    try:
        _Summary.model_validate(summary)
    except ValidationError as error:
        explanation = explain_validation_error(error)
        raise SceneError(f"{path}: {explanation}; it is not a summary that this library wrote") from None
    return summary


def _read_law(folder: Path, names: list[str]) -> dict[str, Any] | None:
    """Read the law of a plan's phases, if the folder holds one."""
    path = folder / "controller.json"
    if not path.exists():
        return None
    try:
        law = controller_to_dict(read_controller(path))
    except BadInput as error:
        raise SceneError(str(error)) from None
    if [phase["name"] for phase in law["phases"]] != names:
        raise SceneError(f"{path}: phases are not those of summary.json")
    return law


def _read_trajectory(path: Path, names: list[str]) -> dict[str, np.ndarray]:
    """Read a trajectory: phase name -> its rows without the name, NaN for empty cells."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SceneError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if tuple(header) != TRAJECTORY_COLUMNS:
        raise SceneError(f"{path}: line 1: the header must be {','.join(TRAJECTORY_COLUMNS)}")
    trajectories: dict[str, list] = {}
    for line, row in enumerate(rows, start=2):
        try:
            time, name, *numbers = row
            values = [float(time), *(float(v) if v else math.nan for v in numbers)]
        except ValueError:
            raise SceneError(f"{path}: line {line}: not a row of numbers") from None
        if name not in names or len(row) != len(header):
            raise SceneError(f"{path}: line {line}: not a row of any phase in summary.json")
        trajectories.setdefault(name, []).append(values)
    return {name: np.array(values) for name, values in trajectories.items()}
