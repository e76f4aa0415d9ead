r"""Newton's methods on a path: in a plane across it, and along it to a zero of a function.

With `[K x] = [G; u]^-1`, where `x = dz/ds` in the chart with direction `u` and `K` corrects `z` back onto the
constraints, each step along the path is

    z <- z - K C(z) - x f / f',      f' = df/ds along x and x' = d2z/ds2

so that only `f` is differentiated, once, along the path. Off the path the variation of `f` is neglected; as each step
ends on the path up to the square of its length, the digits double with every second step. The first step leaves `f`
out: off the path its value says little, and of two close roots either could result. The iterations run on constants;
one further step, with the last iteration's `K`, `x'` and `f'`, carries the derivatives by the implicit function
theorem: `z - K C(z)` lies on the path however the scene moves, and `f` is evaluated there. Second derivatives of the
root are not carried.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from wholearm_jax.core import eps_power, fused_matmul, inverse_and_determinant
from wholearm_jax.model import (
    ScaledMechanics,
    constraint_jacobian,
    constraint_second_derivative,
    constraint_velocity,
    constraints,
)


class PathRoot(NamedTuple):
    """A root on a path."""

    z: Float[Array, "5"]  # configuration
    x: Float[Array, "5"]  # tangent dz/ds
    residual: Float[Array, ""]  # largest residual at the last iterate but one
    steps: Int[Array, ""]  # number of Newton steps


class LocalPath(NamedTuple):
    """First and second derivatives of a path at one place, in the chart with direction `u`."""

    constraint_inverse: Float[Array, "5 rows"]  # K
    x: Float[Array, "5"]  # dz/ds
    curvature: Float[Array, "5"]  # x' = d2z/ds2
    determinant: Float[Array, ""]  # det [G; u]


def path_derivatives(mechanics: ScaledMechanics, z: Float[Array, "5"], u: Float[Array, "5"]) -> LocalPath:
    """Evaluate a path's derivatives at `z`: `G x = 0`, `u . x = 1`, `G x' = -x^T H x`, `u . x' = 0`."""
    inverse, determinant = inverse_and_determinant(
        jnp.concatenate([constraint_jacobian(mechanics.contacts, z), u[None]])
    )
    back, x = inverse[:, :4], inverse[:, 4]
    return LocalPath(back, x, -fused_matmul(back, constraint_second_derivative(mechanics.contacts, z, x)), determinant)


def newton_corrector(mechanics: ScaledMechanics, u, z, height, max_iterations: int, tolerance: ArrayLike = 0.0):
    """Solve the constraints in the plane `u . z = height` by Newton's method, until a step is at most `tolerance`.

    Returns:
        The configuration (5,), the size of the last step (infinite if it is NaN), and `[G; u]^-1` (5, 5) with its
        determinant before that step.
    """

    def iterate(state):
        z, count, *_ = state
        inverse, determinant = inverse_and_determinant(
            jnp.concatenate([constraint_jacobian(mechanics.contacts, z), u[None]])
        )
        residual = jnp.concatenate([constraints(mechanics.contacts, z), (u @ z - height)[None]])
        step = fused_matmul(inverse, residual)
        return z - step, count + 1, jnp.abs(step).max(), inverse, determinant

    def continues(state):
        _, count, step_size, *_ = state
        return (count < max_iterations) & (step_size > tolerance)

    far, eye = jnp.asarray(jnp.inf, z.dtype), jnp.eye(5, dtype=z.dtype)
    start = (z, jnp.asarray(0, int), far, eye, jnp.ones((), z.dtype))
    z, _, step_size, inverse, determinant = jax.lax.while_loop(continues, iterate, start)
    return z, jnp.where(jnp.isfinite(step_size), step_size, jnp.inf), inverse, determinant


def solve_on_path(
    function: Callable,
    mechanics: ScaledMechanics,
    z: Float[Array, "5"],
    u: Float[Array, "5"],
    *parameters,
    steps: int = 20,
    max_step: float = 0.3,
) -> PathRoot:
    """Find the place near `z` on a path where `function(mechanics, z, x, *parameters)` is 0, to rounding level.

    Args:
        function: a scalar function of the place and its tangent `x`, `u . x = 1`.
        mechanics: the formation in object units.
        z: where the search starts (5,).
        u: the chart's direction (5,).
        parameters: arrays that `function` depends on.
        steps: the largest number of Newton steps.
        max_step: the largest step [object radii or radians].

    Returns:
        The root. Where there is none, `residual` is large; no value is NaN and nothing is raised.
    """
    fixed, fixed_parameters, u = stop_gradient((mechanics, parameters, u))

    def step(state):
        z, _, _, _, count, _ = state
        local = path_derivatives(fixed, z, u)
        value, rate = jax.jvp(
            lambda z, x: function(fixed, z, x, *fixed_parameters), (z, local.x), (local.x, local.curvature)
        )
        residual = constraints(fixed.contacts, z)
        move = -fused_matmul(local.constraint_inverse, residual) - local.x * jnp.where(count > 0, value / rate, 0.0)
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        size = jnp.abs(move).max()
        move = move * jnp.minimum(1.0, max_step / jnp.maximum(size, max_step * jnp.finfo(z.dtype).eps))
        return z + move, local, rate, jnp.maximum(jnp.abs(residual).max(), jnp.abs(value)), count + 1, size

    def continues(state):
        *_, residual, count, size = state
        # The remaining error is of the square of the step.
        return (count < steps) & ((count < 2) | (size > eps_power(z, 9 / 16))) & (residual > 0)

    # Iterate on constants.
    far, none = jnp.asarray(jnp.inf, z.dtype), jnp.zeros(5, z.dtype)
    unknown = LocalPath(jnp.zeros((5, 4), z.dtype), none, none, jnp.zeros((), z.dtype))
    start = (stop_gradient(z), unknown, far, far, jnp.asarray(0, int), far)
    z, local, rate, residual, count, _ = stop_gradient(jax.lax.while_loop(continues, step, start))
    residual = jnp.where(jnp.isfinite(residual), residual, jnp.inf)
    # Take one differentiable step: back onto the constraints, then along the path.
    correction = fused_matmul(local.constraint_inverse, constraints(mechanics.contacts, z))
    z = z - jnp.where(jnp.isfinite(correction), correction, 0.0)
    turn = fused_matmul(local.constraint_inverse, constraint_velocity(mechanics.contacts, z, local.x))
    x = jnp.where(jnp.isfinite(local.x), local.x, u) - jnp.where(jnp.isfinite(turn), turn, 0.0)
    advance = function(mechanics, z, x, *parameters) / rate
    advance = jnp.where(jnp.isfinite(advance), advance, 0.0)
    tangent, curvature = (jnp.where(jnp.isfinite(a), a, 0.0) for a in (local.x, local.curvature))
    return PathRoot(z - tangent * advance, x - curvature * advance, residual, count)
