"""Advice on a phase whose path or motion loses rank: which of the causes it is."""

import equinox as eqx
import numpy as np

from wholearm_jax.core import Status
from wholearm_jax.model import (
    COORDINATES,
    Phase,
    Scene,
    anchor_rolling,
    constraint_jacobian,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.phases import TracedPhase

REMEDY_WEDGE = "lower the friction, or choose other contacts"
REMEDY_FOLD = "end the phase before with `until`, or choose other contacts"
REMEDY_RIGID = "choose other contacts"
RANK_TOL = 1e-8  # of singular values, and of a coordinate's share in the motion


def explain_singular(scene: Scene, phase: Phase, traced: TracedPhase) -> tuple[str, str]:
    """Return cause and remedy of a phase with the status `singular`.

    Args:
        scene: the plan.
        phase: the phase.
        traced: its trace, with that status of the path or of the dynamics.
    """
    if int(traced.path.status) != Status.SINGULAR:
        return "friction and contacts wedge the object: forces along the path are not determined", REMEDY_WEDGE
    rows = np.asarray(_gradients(scene, phase, traced.path.start))
    _, sizes, directions = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True))
    if sizes[-1] < RANK_TOL:
        return "at its start the contacts depend on one another: a fold or a branch", REMEDY_RIGID
    share, wanted = np.abs(directions[-1]), int(phase.target.coordinate)
    moving = [name for name, part in zip(COORDINATES, share, strict=True) if part > RANK_TOL]
    if wanted >= 0 and share[wanted] <= RANK_TOL:
        still = f"{COORDINATES[wanted]}, which `toward` names, stands still on this path"
        return still, f"name one that moves: {', '.join(moving)}"
    return "the path comes to a fold or a branch", REMEDY_FOLD


@eqx.filter_jit
def _gradients(scene: Scene, phase: Phase, z):
    """Return the gradients of the constraints with respect to scaled configurations (4, 5) at one of them."""
    mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, phase.formation)
    return constraint_jacobian(anchor_rolling(mechanics.contacts, z), z)
