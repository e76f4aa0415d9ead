"""The rows of contacts at places of a path: what the tangents and the statics of all their formations are made of."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

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
    """Contacts at places of a path, in the object's units, and what acts on them.

    Fingers that are away are contacts that hold their joints' angles.
    """

    names: tuple[str, ...]
    normal: Float[np.ndarray, "places contacts 5"]  # gradients of the gaps, `G_n`
    tangential: Float[np.ndarray, "places contacts 5"]  # `G_t`
    clearance: Float[np.ndarray, "places contacts"]  # distances from the ends of their features
    same_tip: Bool[np.ndarray, "contacts contacts"]  # which two hold a fingertip at a vertex, at the first place
    friction: Float[np.ndarray, "contacts"]
    weight: Float[np.ndarray, "5"]
    dry: Float[np.ndarray, "2"]  # friction of the joints
    torque_limit: Float[np.ndarray, "2"]
    force_unit: float  # [N]

    def between(self, at: Float[np.ndarray, "others"]) -> "ContactRows":
        """Return the rows between places, by linear interpolation: `at` are numbers of places, with fractions."""
        before = np.minimum(at.astype(int), len(self.normal) - 2)
        share = (at - before)[:, None, None]
        normal, tangential, clearance = (
            a[before] + share * (a[before + 1] - a[before])
            for a in (self.normal, self.tangential, self.clearance[..., None])
        )
        return self._replace(normal=normal, tangential=tangential, clearance=clearance[..., 0])


# In NumPy: passing its arrays to a compiled program takes a tenth of the time of moving each to a device.
@functools.lru_cache(maxsize=4096)
def formation_in_numpy(contacts: tuple[str, ...]) -> ContactFormation:
    """Build a formation, its arrays in NumPy."""
    return jax.tree.map(np.asarray, contact_formation(contacts))


def contact_rows(
    scene: Scene, places: Float[np.ndarray, "places 5"], contacts: Sequence[str], away: Sequence[str] = ()
) -> ContactRows:
    """Compute the rows of contacts, and of fingers that are away, at configurations (SI)."""
    # As if all slid: one program for up to `ROWS_STEP` contacts.
    every = formation_in_numpy((*contacts, *[contacts[0]] * (-len(contacts) % ROWS_STEP)))
    found = jax.device_get(_rows_at(rigid_body(scene.object), scene.hand, scene.gravity, every, places))
    (normal, tangential, clearance), same_tip, friction, *loads = found
    count, more = len(contacts), len(away)
    held = np.zeros((len(places), more, 5))
    held[:, range(more), [3 + AWAY_NAMES.index(name) for name in away]] = 1.0
    return ContactRows(
        (*contacts, *away),
        np.concatenate([normal[:, :count], held], axis=1),
        np.concatenate([tangential[:, :count], np.zeros_like(held)], axis=1),
        np.concatenate([clearance[:, :count], np.full((len(places), more), np.inf)], axis=1),
        np.pad(same_tip[:count, :count], (0, more)),
        np.append(friction[:count], np.zeros(more)),
        *loads,
    )


@CachedJit
def _rows_at(body, hand, gravity, formation, places):
    mechanics = scaled_mechanics(body, hand, gravity, formation)
    contacts = mechanics.contacts

    def rows(z):
        clearance = feature_clearance(contacts, contact_kinematics(contacts, z))
        return normal_jacobian(contacts, z), tangential_jacobian(contacts, z), clearance

    small = places / mechanics.configuration_unit
    at = contact_kinematics(contacts, small[0])
    weight = jax.numpy.pad(mechanics.inertia[0] * mechanics.gravity, (0, 3))
    limit = mechanics.torque_limit / mechanics.torque_unit
    loads = weight, mechanics.dry, limit, mechanics.force_unit
    return jax.vmap(rows)(small), hold_same_tip(contacts, at, contacts, at), contacts.friction, *loads
