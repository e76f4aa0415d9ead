"""A fingertip at a vertex of the object: which contacts a path may hold there, and which mean nothing there.

A corner on a corner slips off along either side. There a tip touches both edges and its finger the vertex, but a path
holds one of the three: the gaps of the others may turn negative, for the tip is then beside their edge.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from wholearm_jax.model import CORNER_TOL, ContactKinematics, ContactSet


def hold_same_tip(
    contacts: ContactSet, at: ContactKinematics, others: ContactSet, at_others: ContactKinematics
) -> Bool[Array, "rows others"]:
    """Which contacts hold, with which others, a fingertip at a vertex of the object from two sides.

    Only in a notch, a vertex where the outline turns inward, two edges hold a tip.

    Args:
        contacts: one set of contacts, the object's in every row.
        at: their kinematics.
        others: the other set.
        at_others: their kinematics.
    """

    def of_each_two(function, values, of_others):
        return function(values[:, None], of_others[None, :])

    (x, y), (other_x, other_y) = at.from_object, at_others.from_object
    distance = jnp.hypot(of_each_two(jnp.subtract, x, other_x), of_each_two(jnp.subtract, y, other_y))
    one_finger = sum(of_each_two(jnp.multiply, *pair) for pair in zip(contacts.finger, others.finger, strict=True)) > 0
    on_link = of_each_two(jnp.not_equal, contacts.on_link, others.on_link)

    # Two edges: the one that ends at the vertex comes before the one that begins there.
    (ex, ey), (other_ex, other_ey) = contacts.edge, others.edge
    turn = of_each_two(jnp.multiply, ex, other_ey) - of_each_two(jnp.multiply, ey, other_ex)
    comes_after = of_each_two(jnp.less, at.along, at_others.along)
    # Above rounding: with itself an edge turns nowhere.
    turns_outward = ~contacts.on_link[:, None] & ~others.on_link & (jnp.where(comes_after, -turn, turn) > CORNER_TOL)
    both_gaps = of_each_two(jnp.logical_and, _hold_gap(contacts), _hold_gap(others))
    return both_gaps & one_finger & (distance < CORNER_TOL) & (on_link | turns_outward)


def _hold_gap(contacts: ContactSet) -> Bool[Array, "rows"]:
    return ~contacts.tangential if contacts.is_away is None else ~contacts.tangential & ~contacts.is_away


def feature_clearance(contacts: ContactSet, at: ContactKinematics) -> Float[Array, "*places rows"]:
    """How far contacts are from the nearer end of their features; negative beyond it."""
    return jnp.minimum(at.along - contacts.lower, contacts.upper - at.along)


def pivot_clearance(contacts: ContactSet, at: ContactKinematics) -> Float[Array, "rows"]:
    """How far contacts that roll are from the ends of their features; infinite for those that do not.

    A vertex that turns on the very tip of a finger, or a tip that turns on the end of an edge, slips off either side.

    Args:
        contacts: of a formation.
        at: their kinematics.
    """
    return jnp.where(contacts.tangential, feature_clearance(contacts, at), jnp.inf)


def run_into_object(
    contacts: ContactSet, at: ContactKinematics, z: Float[Array, "5"], tolerance: Float[Array, ""]
) -> Bool[Array, "rows"]:
    """Which contacts hold a fingertip at an edge from whose inner side the finger comes.

    Args:
        contacts: of a formation.
        at: their kinematics at `z`.
        z: the configuration.
        tolerance: depth at the edge's other end that counts as flush.
    """
    (first, second), (nx, ny) = contacts.finger, at.normal
    cosine, sine = (first * of_angle(z[3]) + second * of_angle(z[4]) for of_angle in (jnp.cos, jnp.sin))
    inward = -(nx * cosine + ny * sine)  # of the direction from the tip to the joint
    return ~contacts.on_link & _hold_gap(contacts) & (inward * contacts.upper > tolerance)
