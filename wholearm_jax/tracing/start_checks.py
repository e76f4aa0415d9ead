"""Checks of a path's start: contact limits, penetration, and dependent constraints.

Derivation: section 3 of `docs/derivation.md`.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import eps_power, null_vector
from wholearm_jax.model import (
    CORNER_TOL,
    EDGE,
    FEATURE_GROUPS,
    FINGER_ROOT,
    PALM_END,
    VERTEX,
    ContactKinematics,
    ScaledMechanics,
    constraint_jacobian,
    contact_kinematics,
    link_overlaps,
    next_vertex,
)
from wholearm_jax.tracing.corners import feature_clearance, hold_same_tip, pivot_clearance, run_into_object


def violates_contact_limits(mechanics: ScaledMechanics, z: Float[Array, "5"]) -> Bool[Array, ""]:
    """Whether a configuration `z` is inadmissible as a path's start.

    That is so where a contact lies beyond its feature, a vertex behind the palm, part of a link within the object, the
    object behind a link that one of its vertices touches, or a vertex of a convex object behind a finger on which
    another one slides, where two contacts hold a fingertip at a vertex, or the finger would cut that vertex off, or
    where a contact rolls at the end of its feature.
    Behind a finger whose tip touches an edge, vertices may lie.
    """
    tolerance = eps_power(z, 5 / 8)
    flush_tolerance = jnp.maximum(tolerance, mechanics.flush_tolerance)
    contacts, pairs = contact_kinematics(mechanics.contacts, z), contact_kinematics(mechanics.candidates, z)
    beyond = feature_clearance(mechanics.contacts, contacts) < -tolerance
    inside = (pairs.along > mechanics.candidates.lower) & (pairs.along < mechanics.candidates.upper)
    behind = (
        mechanics.may_terminate
        & mechanics.candidates.on_link
        & ~mechanics.may_be_behind
        & inside
        & (pairs.gap < -flush_tolerance)
    )
    held = mechanics.exists & ~mechanics.may_terminate & mechanics.candidates.on_link
    from_behind = held & inside & ~lie_before_link(mechanics, pairs.gap, flush_tolerance)
    return (
        jnp.any(beyond)
        | jnp.any(behind)
        | jnp.any(from_behind)
        | jnp.any(hold_same_tip(mechanics.contacts, contacts, mechanics.contacts, contacts))
        | jnp.any(pivot_clearance(mechanics.contacts, contacts) < CORNER_TOL)
        | jnp.any(run_into_object(mechanics.contacts, contacts, z, flush_tolerance))
        | link_penetrates_object(mechanics, pairs, flush_tolerance)
    )


def links_overlap(mechanics: ScaledMechanics, z: Float[Array, "5"]) -> Bool[Array, ""]:
    """Whether links lie in one another at `z`, or a joint is beyond its range."""
    return jnp.any(link_overlaps(mechanics.hand, z[3:]) > eps_power(z, 5 / 8))


def lie_before_link(
    mechanics: ScaledMechanics, gap: Float[Array, "candidates"], tolerance: Float[Array, ""]
) -> Bool[Array, "candidates"]:
    """Whether the two sides of the object at a vertex lie, taken together, in front of a link's line.

    `gap` is that of `mechanics.candidates`; only rows of vertices mean anything.
    """
    of_group, exists = (a.reshape(len(FEATURE_GROUPS), -1) for a in (gap, mechanics.exists))
    vertex, count = jnp.arange(exists.shape[1]), exists[0].sum()
    before, after = jnp.where(vertex > 0, vertex, count) - 1, next_vertex(count, vertex.shape[0])
    return (of_group[:, before] + of_group[:, after] > -2 * tolerance).ravel()


# Each link's two ends, and the vertices against that link: fingers from root to tip, the palm from left to right.
_LINK_GROUPS = (
    ((1, FINGER_ROOT), (1, EDGE), (1, VERTEX)),
    ((2, FINGER_ROOT), (2, EDGE), (2, VERTEX)),
    ((2, PALM_END), (1, PALM_END), (0, VERTEX)),
)
_BEGIN, _END, _VERTICES = np.array([[FEATURE_GROUPS.index(group) for group in link] for link in _LINK_GROUPS]).T


def link_penetrates_object(mechanics: ScaledMechanics, pairs: ContactKinematics, tolerance) -> Bool[Array, ""]:
    """Whether part of a finger's contact edge or of the palm lies within the object.

    The lines through the object's edges cut each link into parts. The midpoint of a part lies within the object where
    the outline crosses the rest of the link's line an odd number of times. Gaps and places along edges are linear on a
    link. `pairs` are the kinematics of `mechanics.candidates`.
    """
    grouped = (pairs.gap, pairs.along, mechanics.candidates.lower, mechanics.candidates.upper, mechanics.exists)
    gap, along, lower, upper, exists = (a.reshape(len(FEATURE_GROUPS), -1) for a in grouped)

    def on_link(values, fraction):
        return values[_BEGIN][:, None] + fraction[..., None] * (values[_END] - values[_BEGIN])[:, None]

    # Cut each link where the line through an edge meets it; `middle` are the midpoints of the parts.
    drop = gap[_BEGIN] - gap[_END]
    fraction = gap[_BEGIN] / jnp.where(drop == 0, 1.0, drop)
    is_cut = exists[_BEGIN] & (drop != 0) & (fraction > 0) & (fraction < 1)
    cuts = jnp.concatenate([jnp.zeros((3, 1), fraction.dtype), jnp.where(is_cut, fraction, 1.0)], axis=1)
    next_cut = jnp.where(cuts[:, None] > cuts[..., None], cuts[:, None], 1.0).min(-1)
    middle = (cuts + next_cut) / 2

    # A part that lies along an edge of the object touches it from outside.
    edge_length = upper[_END[0]]  # the same for every link
    on_line, place = jnp.abs(on_link(gap, middle)) < tolerance, on_link(along, middle)
    on_edge = exists[_BEGIN][:, None] & on_line & (place > -tolerance) & (place < edge_length + tolerance)

    # Count the outline's crossings of the link's line beyond each midpoint.
    front, where = gap[_VERTICES], along[_VERTICES]
    last = exists[_VERTICES] & ~jnp.roll(exists[_VERTICES], -1, axis=1)
    front_next, where_next = (jnp.where(last, a[:, :1], jnp.roll(a, -1, axis=1)) for a in (front, where))
    crosses = exists[_VERTICES] & ((front > 0) != (front_next > 0))
    crossing = where + (where_next - where) * front / jnp.where(crosses, front - front_next, 1.0)
    here = lower[_VERTICES, :1] + middle * (upper - lower)[_VERTICES, :1]
    crossings_beyond = (crosses[:, None] & (crossing[:, None] > here[..., None])).sum(-1)
    return jnp.any((next_cut > cuts) & (crossings_beyond % 2 == 1) & ~on_edge.any(-1))


def is_rank_deficient(mechanics: ScaledMechanics, z: Float[Array, "5"]) -> Bool[Array, ""]:
    """Whether the constraints' normalised gradients at `z` span no volume: the contacts depend on one another."""
    rows = constraint_jacobian(mechanics.contacts, z)
    rows = rows / jnp.sqrt((rows**2).sum(1, keepdims=True))
    return (null_vector(rows) ** 2).sum() < eps_power(z, 3 / 4)
