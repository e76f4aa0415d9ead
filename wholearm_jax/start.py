"""The wire's start: the place nearest to a rough one where a formation's contacts touch, and whether it can be one.

Derivation: section 3 of `docs/derivation.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from wholearm_jax.contacts import constraint_rows, constraints, frames
from wholearm_jax.elimination import inverse, solve, times
from wholearm_jax.march import tangent
from wholearm_jax.newton import newton
from wholearm_jax.precision import digits


def project(system, rough):
    """The wire's point nearest to the rough start: least-norm Newton steps to reach it, then Newton on nearness."""
    fixed, far = stop_gradient(system), stop_gradient(rough)

    def least(z):
        rows = constraint_rows(fixed.contacts, z)
        move = -times(rows.T, solve(times(rows, rows.T), constraints(fixed.contacts, z)))
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        return z + move * jnp.minimum(1.0, 0.3 / jnp.maximum(jnp.abs(move).max(), 1e-30))

    z = jax.lax.fori_loop(0, 12, lambda _, z: least(z), far)
    hint = _null(fixed, z)

    def nearest(z, system, rough):
        return jnp.concatenate([constraints(system.contacts, z), (tangent(system, z, hint) @ (z - rough))[None]])

    root = newton(nearest, z, system, rough)
    near = jnp.where(root.residual < digits(z, 3 / 8), root.z, z)
    return near, jnp.abs(constraints(fixed.contacts, stop_gradient(near))).max()


def misplaced(system, z):
    """Whether a contact lies beyond its feature, a vertex behind the palm, or a convex object on a finger or behind it.

    Behind a finger's line, vertices of a convex object may lie where the finger's tip touches an edge, not where a
    vertex touches the finger.
    """
    tolerance = digits(z, 5 / 8)
    held, pairs = frames(system.contacts, z), frames(system.candidates, z)
    beyond = (held.along < system.contacts.lower - tolerance) | (held.along > system.contacts.upper + tolerance)
    inside = (pairs.along > system.candidates.lower) & (pairs.along < system.candidates.upper)
    of_finger, held_by = system.candidates.finger > 0, (system.contacts.finger > 0) & system.contacts.on_link[:, None]
    faces = ~of_finger.any(1) | (system.convex & (of_finger & held_by.any(0)).any(1))  # in front of them all must be
    behind = system.watched & system.candidates.on_link & faces & inside & (pairs.gap < -tolerance)
    return jnp.any(beyond) | jnp.any(behind) | (system.convex & _pierced(system, z, pairs.gap, tolerance))


def _pierced(system, z, tip, tolerance):
    """Whether part of a finger's contact edge lies within a convex object: behind all of its edges."""
    several = system.candidates
    root = frames(eqx.tree_at(lambda c: c.reach, several, jnp.zeros_like(several.reach)), z).gap
    root, rise = root + tolerance, tip - root
    cross = -root / jnp.where(rise == 0, 1.0, rise)  # where, from root (0) to tip (1), an edge's line is crossed
    enter = jnp.where(rise < 0, cross, jnp.where((rise == 0) & (root > 0), jnp.inf, -jnp.inf))
    leave = jnp.where(rise > 0, cross, jnp.inf)

    def within(finger):
        edges = ~several.on_link & (several.finger[:, finger] > 0) & system.real
        first = jnp.where(edges, enter, -jnp.inf).max()
        last = jnp.where(edges, leave, jnp.inf).min()
        return jnp.minimum(last, 1.0) > jnp.maximum(first, 0.0)

    return within(0) | within(1)


def dependent(system, z):
    """Whether the constraints depend on one another at `z`: their rows span no volume."""
    rows = constraint_rows(system.contacts, z)
    rows = rows / jnp.sqrt((rows**2).sum(1, keepdims=True))
    return inverse(times(rows, rows.T))[1] < digits(z, 3 / 4)


def _null(system, z):
    """The unit tangent at `z`, of either sense: the longest column of the projector onto what is orthogonal to `G`."""
    rows = constraint_rows(system.contacts, z)
    projector = jnp.eye(5, dtype=z.dtype) - times(rows.T, solve(times(rows, rows.T), rows))
    # The projector has half of the digits where rows are nearly dependent, which is enough for a hint.
    return tangent(system, z, projector[jnp.argmax(jnp.diag(projector))])


def oriented(system, z, heading):
    """The unit tangent at `z` whose coordinate `heading.coordinate` has the sign asked for."""
    null = _null(system, z)
    return null * jnp.where(null[leading(heading, null)] * heading.sign < 0, -1.0, 1.0)


def leading(heading, x):
    """The coordinate that tells which way a wire goes."""
    return jnp.where(heading.coordinate < 0, jnp.argmax(jnp.abs(x)), heading.coordinate)
