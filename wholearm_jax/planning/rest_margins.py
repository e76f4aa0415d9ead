"""Margins at rest of all formations of some contacts at a configuration: which of them may begin there?

At rest the forces of a formation, slipping by its path, balance the weight, the joints' friction and the torques: five
equations for six unknowns, four forces and two torques. The least slack is concave in the one that is left, so that its
maximum lies where two slacks meet or at a limit (as in `best_quasistatic_torque`, which takes a place of a tabulated
path; here many formations, none of them traced). Derivation: section 8 of `docs/derivation.md`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from wholearm_jax.planning.contact_rows import ContactRows

WEDGING_CONDITION = 1e-6  # share of the largest singular value below which four constraints do not fix a path
LEAST_SLIP = 1e-9  # of a contact or a joint, for a unit step along a path; what moves less has friction of either sign


class Tangents(NamedTuple):
    """Directions of the paths of formations with the same number of rolling contacts."""

    number: Int[np.ndarray, "formations contacts"]  # of each contact among the rows; those that roll come first
    rolling: int
    direction: Float[np.ndarray, "formations 5"]
    is_path: Bool[np.ndarray, "formations"]  # whether the constraints are independent


def path_tangents(rows: ContactRows, number: Int[np.ndarray, "formations contacts"], rolling: int) -> Tangents:
    """Compute the null vectors of formations' four constraints."""
    _, values, right = np.linalg.svd(
        np.concatenate([rows.normal[number], rows.tangential[number[:, :rolling]]], axis=1)
    )
    return Tangents(number, rolling, right[:, 4], values[:, -1] > WEDGING_CONDITION * values[:, 0])


def both_senses(tangents: Tangents) -> Tangents:
    """Append the same paths in the opposite directions."""
    number, rolling, direction, is_path = tangents
    twice = np.concatenate([number, number]), rolling, np.concatenate([direction, -direction])
    return Tangents(*twice, np.concatenate([is_path, is_path]))


def rest_margins(rows: ContactRows, tangents: Tangents) -> Float[np.ndarray, "formations"]:
    """Compute the largest margins [N] at rest of formations whose friction is that of setting out along their paths.

    Args:
        rows: the contacts.
        tangents: the formations' paths, in the directions in which they are to be followed.

    Returns:
        The margins; minus infinity where no torques within limits hold the object, or constraints depend on each other.
        Infinity where a finger is away, and where a contact does not slip at first though the object moves: which sign
        its friction will have is not known there.
    """
    number, rolling, direction, is_path = tangents
    normal, tangential, friction = rows.normal[number], rows.tangential[number], rows.friction[number]
    slip = (tangential[:, rolling:] @ direction[..., None])[..., 0]
    # Unknowns, a row each: forces c_n, then c_t of contacts that roll, then torques.
    drag = (friction[:, rolling:] * _sign(slip))[..., None] * tangential[:, rolling:]
    torques = np.broadcast_to(np.eye(5)[3:], (len(number), 2, 5))
    forces = normal[:, :rolling], normal[:, rolling:] - drag, tangential[:, :rolling]
    wrench = np.concatenate([*forces, torques], axis=1)
    load = np.broadcast_to(rows.weight, direction.shape).copy()
    load[:, 3:] -= _sign(direction[:, 3:]) * rows.dry

    # One solution, and the direction in which there are others.
    left, values, right = np.linalg.svd(np.swapaxes(wrench, 1, 2))
    balanced = values[:, -1] > WEDGING_CONDITION * values[:, 0]
    share = (np.swapaxes(left, 1, 2) @ load[..., None])[..., 0] / np.where(balanced[:, None], values, 1.0)
    base = -(np.swapaxes(right[:, :5], 1, 2) @ share[..., None])[..., 0]
    margin = _best(base, right[:, 5], friction[:, :rolling], rows.torque_limit) * rows.force_unit

    unknown = ((_sign(slip) == 0) & (friction[:, rolling:] > 0)).any(1)
    unknown |= ((_sign(direction[:, 3:]) == 0) & (rows.dry > 0)).any(1)
    unknown &= (_sign(direction[:, :3]) != 0).any(1)  # with an object at rest, what is still remains so
    known = np.where(unknown | rows.is_away[number].any(1), np.inf, margin)
    return np.where(is_path & balanced, known, -np.inf)


def _sign(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) < LEAST_SLIP, 0.0, np.sign(values))


def _best(base, direction, cone: Float[np.ndarray, "formations rolling"], torque_limit) -> np.ndarray:
    """Return the largest least slack of unknowns `base + x direction` with torques within limits; -inf: none are."""
    rolling = cone.shape[-1]

    def slacks(unknowns):
        limit, tangential = cone * unknowns[..., :rolling], unknowns[..., 4 - rolling : 4]
        return np.concatenate([unknowns[..., : 4 - rolling], limit - tangential, limit + tangential], axis=-1)

    offset, slope = slacks(base), slacks(direction)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([-torque_limit - base[..., 4:], torque_limit - base[..., 4:]]) / direction[..., 4:]
        low, high = ends.min(0).max(-1), ends.max(0).min(-1)
        first, second = np.triu_indices(offset.shape[-1], 1)
        meets = (offset[..., second] - offset[..., first]) / (slope[..., first] - slope[..., second])
        x = np.clip(np.concatenate([low[..., None], high[..., None], meets], -1), low[..., None], high[..., None])
        least = (offset[..., None, :] + x[..., None] * slope[..., None, :]).min(-1)
    return np.where(low <= high, np.where(np.isfinite(least), least, -np.inf).max(-1), -np.inf)
