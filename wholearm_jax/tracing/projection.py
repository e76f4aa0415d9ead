"""The wire's start: the place nearest to a rough one where a formation's contacts touch, and whether it can be one.

Derivation: section 3 of `docs/derivation.md`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from wholearm_jax.core import eps_power, fused_matmul, null_vector, solve
from wholearm_jax.model import (
    EDGE,
    FEATURE_GROUPS,
    FINGER_ROOT,
    PALM_END,
    VERTEX,
    constraint_jacobian,
    constraints,
    contact_kinematics,
)
from wholearm_jax.tracing.continuation import oriented_tangent
from wholearm_jax.tracing.path_root import solve_on_path


def project_onto_path(mechanics, initial_guess):
    """The wire's point nearest to the rough start: least-norm Newton steps to reach it, then Newton on nearness.

    Beside it how far constraints are from holding there, and a unit vector along the wire, of either sense.
    """
    fixed, far = stop_gradient(mechanics), stop_gradient(initial_guess)

    def least(z):
        rows = constraint_jacobian(fixed.contacts, z)
        move = -fused_matmul(rows.T, solve(fused_matmul(rows, rows.T), constraints(fixed.contacts, z)))
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        return z + move * jnp.minimum(1.0, 0.3 / jnp.maximum(jnp.abs(move).max(), 1e-30))

    z = jax.lax.fori_loop(0, 12, lambda _, z: least(z), far)
    tangent, _ = oriented_tangent(fixed, z, far)  # of either sense
    root = solve_on_path(
        lambda mechanics, z, x, initial_guess: x @ (z - initial_guess), mechanics, z, tangent, initial_guess
    )
    near = jnp.where(root.residual < eps_power(z, 3 / 8), root.z, z)
    fixed_near = stop_gradient(near)
    along, _ = oriented_tangent(fixed, fixed_near, stop_gradient(root.x))
    return near, jnp.abs(constraints(fixed.contacts, fixed_near)).max(), along


def violates_contact_limits(mechanics, z):
    """Whether a contact lies beyond its feature, a vertex behind the palm, a link within the object, or a convex object
    behind a finger that holds it.

    Behind a finger's line, vertices of a convex object may lie where the finger's tip touches an edge, not where a
    vertex touches the finger.
    """
    tolerance = eps_power(z, 5 / 8)
    held, pairs = contact_kinematics(mechanics.contacts, z), contact_kinematics(mechanics.candidates, z)
    beyond = (held.along < mechanics.contacts.lower - tolerance) | (held.along > mechanics.contacts.upper + tolerance)
    inside = (pairs.along > mechanics.candidates.lower) & (pairs.along < mechanics.candidates.upper)
    behind = (
        mechanics.may_terminate
        & mechanics.candidates.on_link
        & ~mechanics.may_be_behind
        & inside
        & (pairs.gap < -tolerance)
    )
    return jnp.any(beyond) | jnp.any(behind) | _link_penetrates_object(mechanics, pairs, tolerance)


# Where each link begins and ends, and vertices against it: fingers from root to tip, the palm from left to right.
_ENDS = (
    ((1, FINGER_ROOT), (1, EDGE), (1, VERTEX)),
    ((2, FINGER_ROOT), (2, EDGE), (2, VERTEX)),
    ((2, PALM_END), (1, PALM_END), (0, VERTEX)),
)
_LINKS = np.array([[FEATURE_GROUPS.index(group) for group in link] for link in _ENDS]).T


def _link_penetrates_object(mechanics, pairs, tolerance):
    """Whether part of a finger's contact edge or of the palm lies within the object.

    Lines through edges of the object cut each link into parts, and the middle of one lies within where the outline
    passes the rest of the link's line an odd number of times. Gaps and places along edges are linear on a link.
    """
    grouped = (pairs.gap, pairs.along, mechanics.candidates.lower, mechanics.candidates.upper, mechanics.exists)
    gap, along, lower, upper, real = (a.reshape(len(FEATURE_GROUPS), -1) for a in grouped)
    begin, end, against = _LINKS

    def on(values, share):
        return values[begin][:, None] + share[..., None] * (values[end] - values[begin])[:, None]

    across = gap[begin] - gap[end]
    share = gap[begin] / jnp.where(across == 0, 1.0, across)
    cut = real[begin] & (across != 0) & (share > 0) & (share < 1)
    stops = jnp.concatenate([jnp.zeros((3, 1), share.dtype), jnp.where(cut, share, 1.0)], axis=1)
    after = jnp.where(stops[:, None] > stops[..., None], stops[:, None], 1.0).min(-1)
    middle = (stops + after) / 2
    length = upper[end[0]]  # the edges' own, whatever is on them
    near, place = jnp.abs(on(gap, middle)) < tolerance, on(along, middle)
    beside = (real[begin][:, None] & near & (place > -tolerance) & (place < length + tolerance)).any(-1)

    front, where, last = gap[against], along[against], real[against] & ~jnp.roll(real[against], -1, axis=1)
    front_next, where_next = (jnp.where(last, a[:, :1], jnp.roll(a, -1, axis=1)) for a in (front, where))
    passes = real[against] & ((front > 0) != (front_next > 0))
    passed = where + (where_next - where) * front / jnp.where(passes, front - front_next, 1.0)
    here = lower[against, :1] + middle * (upper - lower)[against, :1]
    times_ahead = (passes[:, None] & (passed[:, None] > here[..., None])).sum(-1)
    return jnp.any((after > stops) & (times_ahead % 2 == 1) & ~beside)


def is_rank_deficient(mechanics, z):
    """Whether the constraints depend on one another at `z`: their rows span no volume."""
    rows = constraint_jacobian(mechanics.contacts, z)
    rows = rows / jnp.sqrt((rows**2).sum(1, keepdims=True))
    return (null_vector(rows) ** 2).sum() < eps_power(z, 3 / 4)


def orient_tangent(along, target):
    """A tangent, turned so that its coordinate `path_target.path_coordinate` has the sign asked for."""
    return along * jnp.where(along[dominant_coordinate(target, along)] * target.sign < 0, -1.0, 1.0)


def dominant_coordinate(target, x):
    """The coordinate that tells which way a wire goes."""
    return jnp.where(target.coordinate < 0, jnp.argmax(jnp.abs(x)), target.coordinate)
