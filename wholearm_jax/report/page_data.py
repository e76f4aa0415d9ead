"""Numbers that a page draws: the hand, the object, and every phase sampled, as its script reads them.

Only the positions and normals of the contacts, along which forces are drawn, are not in a result's files: they are
computed from the configurations (`contact_kinematics`).
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import jax
import numpy as np

from wholearm_jax.model import (
    COORDINATES,
    Phase,
    Scene,
    TorqueSchedule,
    contact_kinematics,
    contact_set,
    parse_contact,
    rigid_body,
)
from wholearm_jax.plotting.palette import DASHES, contact_styles
from wholearm_jax.report.result_folder import ResultFolder, critical_phase


def page_data(result: ResultFolder) -> dict[str, Any]:
    """Return the numbers that a page draws, in SI units, as JSON holds them; the object is given about its centre."""
    hand, body = result.scene.hand, rigid_body(result.scene.object)
    end = max((float(rows[-1, 0]) for rows in result.trajectories.values()), default=0.0)
    critical = critical_phase(result.summary)
    fields = ("joint", "length", "offset", "torque_limit")
    return {
        "hand": {name: _rounded(np.asarray(getattr(hand, name))) for name in fields},
        "vertices": _rounded(np.asarray(body.vertices)[: int(body.count)]),
        "phases": _phases(result),
        "torque": _torque_until(result.torque, end),
        "end": end,
        "margin": critical and {key: critical[key] for key in ("margin", "margin_time", "margin_contact")},
        "dashes": DASHES,
    }


def split_columns(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Split a phase's rows into time `t`, configuration `z`, torques `tau` and forces `cn` and `ct` of its contacts."""
    n = len(COORDINATES)
    edges = np.cumsum([0, 1, n, n, 2, 4, 4])
    t, z, _, tau, cn, ct = (rows[:, a:b] for a, b in itertools.pairwise(edges))
    return {"t": t[:, 0], "z": z, "tau": tau, "cn": cn, "ct": ct}


def _phases(result: ResultFolder) -> list[dict[str, Any]]:
    """Return the samples of each phase that moves, with the styles of its contacts."""
    styles = contact_styles(row["contacts"] for row in result.summary["phases"])
    phases = []
    for phase, row in zip(result.scene.phases, result.summary["phases"], strict=True):
        if row["name"] not in result.trajectories:
            continue
        columns = split_columns(result.trajectories[row["name"]])
        count = len(row["contacts"])
        samples = columns | {name: columns[name][:, :count] for name in ("cn", "ct")}
        samples["places"] = _contact_positions(result.scene, phase, columns["z"])
        contacts = [_contact(name, styles[name], result.scene) for name in row["contacts"]]
        phases.append({"name": row["name"], "contacts": contacts} | {k: _rounded(v) for k, v in samples.items()})
    return phases


def _contact(name: str, style: tuple[int, int], scene: Scene) -> dict[str, Any]:
    """Return a contact's name, style, coefficient of friction, and whether it rolls."""
    link, _, _, rolls = parse_contact(name)
    return {"name": name, "style": style, "friction": float(scene.object.friction[link]), "rolls": rolls}


def _torque_until(torque: TorqueSchedule, end: float) -> dict[str, Any]:
    """Return the schedule's rows up to a time, and the torques then."""
    times, values = np.asarray(torque.times), np.asarray(torque.values)
    before = times <= end
    last = [np.interp(end, times, column) for column in values.T]
    return {"t": _rounded([*times[before], end]), "tau": _rounded([*values[before], last])}


def _contact_positions(scene: Scene, phase: Phase, z: np.ndarray) -> np.ndarray:
    """Return each contact's position and its normal into the object, `(samples, contacts, 4)`."""
    contacts = contact_set(rigid_body(scene.object), scene.hand, phase.formation)

    @jax.jit
    @jax.vmap
    def position_and_normal(z):
        kinematics = contact_kinematics(contacts, z)
        position = z[0] + kinematics.from_object[0], z[1] + kinematics.from_object[1]
        return jax.numpy.stack([*position, *kinematics.normal], axis=1)

    return np.asarray(position_and_normal(z))[:, list(phase.formation.normal_rows)]


def _rounded(values) -> Any:
    """Return nested lists with seven significant digits, ten decimals at most, None for NaN: a small page."""
    values = np.asarray(values, float)
    if values.ndim == 0:
        return None if not math.isfinite(values) else float(f"{round(float(values), 10):.7g}")
    return [_rounded(v) for v in values]
