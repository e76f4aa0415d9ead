"""The least normal force on the way, as an execution has it: of the contacts that hold the object while it moves."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from wholearm_jax.model import Scene, feature_pair

WINDOW = 5e-3  # time over which forces are averaged, as motors are noisy [s]
SLOW = 0.2  # share of a phase's mean joint speed below which an object rests: friction takes any part of its forces


class PlannedContacts(NamedTuple):
    """The contacts of each phase, and when it ends by the clock [s]."""

    names: tuple[tuple[str, ...], ...]
    ends: Float[np.ndarray, "phases"]


def planned_contacts(scene: Scene) -> PlannedContacts:
    """Return the contacts of a plan's phases."""
    names = tuple(tuple(map(feature_pair, phase.formation.names)) for phase in scene.phases)
    return PlannedContacts(names, np.cumsum([float(phase.duration) for phase in scene.phases]))


def least_force(
    contacts: PlannedContacts,
    names: tuple[str, ...],
    phase: Int[np.ndarray, "steps"],
    joint_rates: Float[np.ndarray, "steps 2"],
    normal_forces: Float[np.ndarray, "steps contacts"],
    step: float,
) -> float:
    """Return the least normal force [N] on the way; 0 where a phase's contacts never press all at once.

    A force counts while the joints move faster than `SLOW` of their mean speed, from when all contacts of the phase
    press and no others, which they need not where it begins, as parts stop some micrometres before what stops them,
    to when another contact presses, as at the phase's stop: what comes there too fast rebounds.

    Args:
        contacts: Those of the plan.
        names: All contacts, in the order of the columns.
        phase: The phase of each step.
        joint_rates: Of each step [rad/s].
        normal_forces: Of each step [N].
        step: Length of a step [s].

    Returns:
        The force, a mean over `WINDOW`; infinite where nothing moves for so long.
    """
    width, found = max(1, round(WINDOW / step)), np.inf
    for k, held in enumerate(contacts.names):
        rows = np.flatnonzero(phase == k)
        if len(rows) < width:
            continue
        planned = np.isin(names, held)
        forces, speed = normal_forces[rows][:, planned], np.hypot(*joint_rates[rows].T)
        presses, meets = (forces > 0).all(axis=1), (normal_forces[rows][:, ~planned] > 0).any(axis=1)
        moves = _windows(speed > SLOW * speed.mean(), width).all(-1)
        alone = _windows(presses & ~meets, width).all(-1)
        begun = np.cumsum(alone) > 0
        stopped = np.cumsum(begun & _windows(meets, width).any(-1)) > 0
        if moves.any() and not (moves & begun).any():
            return 0.0
        found = min(found, _windows(forces, width).mean(-1)[moves & begun & ~stopped].min(initial=np.inf))
    return float(found)


def _windows(values: Any, width: int) -> np.ndarray:
    """Return every window of consecutive steps, along a last axis."""
    return np.lib.stride_tricks.sliding_window_view(values, width, axis=0)
