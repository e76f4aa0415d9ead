"""Projection of an initial guess onto the path of a contact formation.

Derivation: section 3 of `docs/derivation.md`.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import eps_power, fused_matmul, linear_solve, take_row
from wholearm_jax.model import PathTarget, ScaledMechanics, constraint_jacobian, constraints, contact_kinematics
from wholearm_jax.tracing.curve import oriented_tangent
from wholearm_jax.tracing.path_root import solve_on_path

MAX_SETTLING_DEPTH = 0.02  # [object radii]
MAX_PROJECTION_STEP, PROJECTION_ITERATIONS = 0.3, 12  # of the least-norm Newton iterations [radii or radians]


def project_onto_path(mechanics: ScaledMechanics, initial_guess: Float[Array, "5"]):
    """Find the nearest configuration to an initial guess at which all contacts touch.

    Least-norm Newton steps reach the path; Newton's method along it then finds where `x . (z - initial_guess) = 0`.

    Args:
        mechanics: the formation in object units.
        initial_guess: `z` in object units.

    Returns:
        The configuration (5,), the largest constraint residual there, and a unit tangent (5,) of either sense.
    """
    fixed, guess = stop_gradient(mechanics), stop_gradient(initial_guess)

    def least_norm_step(z):
        rows = constraint_jacobian(fixed.contacts, z)
        move = -fused_matmul(rows.T, linear_solve(fused_matmul(rows, rows.T), constraints(fixed.contacts, z)))
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        return z + move * jnp.minimum(1.0, MAX_PROJECTION_STEP / jnp.maximum(jnp.abs(move).max(), 1e-30))

    def distance_rate(mechanics, z, x, initial_guess):
        return x @ (z - initial_guess)

    z = jax.lax.fori_loop(0, PROJECTION_ITERATIONS, lambda _, z: least_norm_step(z), guess)
    tangent, _ = oriented_tangent(fixed, z, guess)
    root = solve_on_path(distance_rate, mechanics, z, tangent, initial_guess)
    nearest = jnp.where(root.residual < eps_power(z, 3 / 8), root.z, z)
    fixed_nearest = stop_gradient(nearest)
    tangent, _ = oriented_tangent(fixed, fixed_nearest, stop_gradient(root.x))
    return nearest, jnp.abs(constraints(fixed.contacts, fixed_nearest)).max(), tangent


def settle_on_link(
    mechanics: ScaledMechanics,
    start: Float[Array, "5"],
    tangent: Float[Array, "5"],
    may_settle: bool | Bool[Array, ""] = True,
) -> tuple[Float[Array, "5"], Float[Array, "5"]]:
    """Move a start at which a vertex lies a little behind a link along the path until it touches.

    A rough start that is meant flat, with a side on a link, is projected to either side of the flat pose.

    Args:
        mechanics: the formation in object units.
        start: a configuration on the path (5,).
        tangent: the unit tangent there (5,).
        may_settle: whether the start may be moved.

    Returns:
        The configuration and tangent; as given where no vertex is between the tolerance for flush ones and
        `MAX_SETTLING_DEPTH` behind a link, or where the path does not lead to the link.
    """
    fixed, fixed_start = stop_gradient((mechanics, start))
    pairs, at = fixed.candidates, contact_kinematics(fixed.candidates, fixed_start)
    is_watched = fixed.may_terminate & pairs.on_link & ~fixed.may_be_behind
    inside = (at.along > pairs.lower) & (at.along < pairs.upper)
    depth = jnp.where(is_watched & inside, -at.gap, 0.0)
    row, deepest = jnp.argmax(depth), depth.max()

    def gap(mechanics, z, x):
        return contact_kinematics(jax.tree.map(lambda a: take_row(a, row), mechanics.candidates), z).gap

    def settle():
        root = solve_on_path(gap, mechanics, start, stop_gradient(tangent))
        size = jnp.sqrt((root.x**2).sum())
        is_found = root.residual < eps_power(root.z, 1 / 2)
        return jnp.where(is_found, root.z, start), jnp.where(is_found, stop_gradient(root.x / size), tangent)

    lies_behind = (deepest > jnp.maximum(fixed.flush_tolerance, eps_power(start, 5 / 8))) & (
        deepest < MAX_SETTLING_DEPTH
    )
    return jax.lax.cond(may_settle & lies_behind, settle, lambda: (start, tangent))


def orient_tangent(tangent: Float[Array, "5"], target: PathTarget) -> Float[Array, "5"]:
    """Turn a tangent so that the target's coordinate changes with the target's sign."""
    return tangent * jnp.where(tangent[dominant_coordinate(target, tangent)] * target.sign < 0, -1.0, 1.0)


def dominant_coordinate(target: PathTarget, tangent: Float[Array, "5"]) -> Int[Array, ""]:
    """Index of the coordinate that defines a path's direction: the target's, or the one that changes most."""
    return jnp.where(target.coordinate < 0, jnp.argmax(jnp.abs(tangent)), target.coordinate)
