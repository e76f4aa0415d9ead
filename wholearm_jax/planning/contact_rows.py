"""The rows of contacts at a configuration: what the tangents and the statics of all their formations are made of."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import CachedJit
from wholearm_jax.model import (
    AWAY_NAMES,
    ContactFormation,
    Scene,
    contact_formation,
    contact_kinematics,
    normal_jacobian,
    rigid_body,
    scaled_mechanics,
    tangential_jacobian,
)
from wholearm_jax.tracing import feature_clearance, hold_same_tip

ROWS_STEP = 8  # contacts whose rows one program computes; their number is rounded up to a multiple


class ContactRows(NamedTuple):
    """Contacts at a configuration, in the object's units, and what acts on them.

    Fingers that are away are contacts that hold their joints' angles.
    """

    names: tuple[str, ...]
    is_away: Bool[np.ndarray, "contacts"]
    normal: Float[np.ndarray, "contacts 5"]  # gradients of the gaps, `G_n`
    tangential: Float[np.ndarray, "contacts 5"]  # `G_t`
    same_tip: Bool[np.ndarray, "contacts contacts"]  # which two hold a fingertip at a vertex
    clearance: Float[np.ndarray, "contacts"]  # from the nearer end of a contact's feature
    friction: Float[np.ndarray, "contacts"]
    weight: Float[np.ndarray, "5"]
    dry: Float[np.ndarray, "2"]  # friction of the joints
    torque_limit: Float[np.ndarray, "2"]
    force_unit: float  # [N]


# In NumPy: passing its arrays to a compiled program takes a tenth of the time of moving each to a device.
@functools.lru_cache(maxsize=4096)
def formation_in_numpy(contacts: tuple[str, ...]) -> ContactFormation:
    """Build a formation, its arrays in NumPy."""
    return jax.tree.map(np.asarray, contact_formation(contacts))


def contact_rows(
    scene: Scene, z: Float[Array | np.ndarray, "5"], contacts: Sequence[str], away: Sequence[str] = ()
) -> ContactRows:
    """Compute the rows of contacts, and of fingers that are away, at a configuration (SI)."""
    # As if all slid: one program for up to `ROWS_STEP` contacts.
    every = formation_in_numpy((*contacts, *[contacts[0]] * (-len(contacts) % ROWS_STEP)))
    at_z = _rows_at(rigid_body(scene.object), scene.hand, scene.gravity, every, np.asarray(z))
    normal, tangential, same_tip, clearance, friction, *loads = jax.device_get(at_z)
    count, more = len(contacts), len(away)
    held = np.eye(5)[[3 + AWAY_NAMES.index(name) for name in away]]
    return ContactRows(
        (*contacts, *away),
        np.arange(count + more) >= count,
        np.concatenate([normal[:count], held]),
        np.concatenate([tangential[:count], 0 * held]),
        np.pad(same_tip[:count, :count], (0, more)),
        np.append(clearance[:count], np.zeros(more)),
        np.append(friction[:count], np.zeros(more)),
        *loads,
    )


@CachedJit
def _rows_at(body, hand, gravity, formation, z):
    mechanics = scaled_mechanics(body, hand, gravity, formation)
    contacts, small = mechanics.contacts, z / mechanics.configuration_unit
    at = contact_kinematics(contacts, small)
    rows = normal_jacobian(contacts, small), tangential_jacobian(contacts, small)
    weight = jnp.pad(mechanics.inertia[0] * mechanics.gravity, (0, 3))
    limit = mechanics.torque_limit / mechanics.torque_unit
    loads = weight, mechanics.dry, limit, mechanics.force_unit
    tips = hold_same_tip(contacts, at, contacts, at)
    return *rows, tips, feature_clearance(contacts, at), contacts.friction, *loads
