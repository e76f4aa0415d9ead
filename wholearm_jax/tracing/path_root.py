r"""Newton's method along a wire: the place where the constraints hold and a function of the wire vanishes.

With `[K x] = [G; u]^-1`, where `x = dz/ds` in the chart with direction `u` and `K` brings `z` back to the constraints,
each step is

    z <- z - K C(z) - x f / f',      f' = df/ds along x and x' = d2z/ds2

so that nothing is differentiated but `f`, once, along the wire. How `f` changes beside the wire is left out; as each
step ends on it but for the square of its length, the digits double with every second step. The first step leaves `f`
itself out: beside the wire its value says little, and of two places close together it would choose any. The iterations
run on constants; one further step, with the last iteration's `K`, `x'` and `f'`, carries the derivatives, by the
implicit function theorem: `z - K C(z)` lies on the wire however the scene moves, and there `f` counts. Second
derivatives of the root are not carried.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
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
    """A place and `x = dz/ds` there, the largest residual at the last iterate but one, and the number of steps."""

    z: Float[Array, "5"]
    x: Float[Array, "5"]
    residual: Float[Array, ""]
    steps: Int[Array, ""]


class LocalPath(NamedTuple):
    """A wire at one place, in the chart with direction `u`: `K`, `x = dz/ds`, `x' = d2z/ds2` and `det [G; u]`."""

    constraint_inverse: Float[Array, "5 rows"]
    x: Float[Array, "5"]
    curvature: Float[Array, "5"]
    determinant: Float[Array, ""]


def path_derivatives(mechanics: ScaledMechanics, z: Float[Array, "5"], u: Float[Array, "5"]) -> LocalPath:
    """What a wire does at `z`: `G x = 0`, `u.x = 1`, `G x' = -x^T H x`, `u.x' = 0`."""
    inverted, determinant = inverse_and_determinant(
        jnp.concatenate([constraint_jacobian(mechanics.contacts, z), u[None]])
    )
    back, x = inverted[:, :4], inverted[:, 4]
    return LocalPath(back, x, -fused_matmul(back, constraint_second_derivative(mechanics.contacts, z, x)), determinant)


def solve_on_path(
    function: Callable,
    mechanics: ScaledMechanics,
    z: Float[Array, "5"],
    u: Float[Array, "5"],
    *parameters,
    steps: int = 20,
    longest: float = 0.3,
) -> PathRoot:
    """The place near `z` on the wire of `scaled_mechanics` where `function(system, z, x, *parameters)` is 0, to
    rounding level.

    `u.x = 1`; each step is no longer than `longest`. A root that was not found shows in `residual`, never as NaN or an
    exception.
    """
    fixed, settings, u = stop_gradient((mechanics, parameters, u))

    def step(state):
        z, _, _, _, count, _ = state
        at = path_derivatives(fixed, z, u)
        value, rate = jax.jvp(lambda z, x: function(fixed, z, x, *settings), (z, at.x), (at.x, at.curvature))
        left = constraints(fixed.contacts, z)
        move = -fused_matmul(at.constraint_inverse, left) - at.x * jnp.where(count > 0, value / rate, 0.0)
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        size = jnp.abs(move).max()
        move = move * jnp.minimum(1.0, longest / jnp.maximum(size, longest * jnp.finfo(z.dtype).eps))
        return z + move, at, rate, jnp.maximum(jnp.abs(left).max(), jnp.abs(value)), count + 1, size

    def going(state):
        *_, residual, count, size = state
        # What is left is of the square of the step.
        return (count < steps) & ((count < 2) | (size > eps_power(z, 9 / 16))) & (residual > 0)

    far, none = jnp.asarray(jnp.inf, z.dtype), jnp.zeros(5, z.dtype)
    nowhere = LocalPath(jnp.zeros((5, 4), z.dtype), none, none, jnp.zeros((), z.dtype))
    start = (stop_gradient(z), nowhere, far, far, jnp.asarray(0, int), far)
    z, at, rate, residual, count, _ = stop_gradient(jax.lax.while_loop(going, step, start))
    residual = jnp.where(jnp.isfinite(residual), residual, jnp.inf)
    back = fused_matmul(at.constraint_inverse, constraints(mechanics.contacts, z))
    z = z - jnp.where(jnp.isfinite(back), back, 0.0)
    turn = fused_matmul(at.constraint_inverse, constraint_velocity(mechanics.contacts, z, at.x))
    x = jnp.where(jnp.isfinite(at.x), at.x, u) - jnp.where(jnp.isfinite(turn), turn, 0.0)
    late = function(mechanics, z, x, *parameters) / rate
    late = jnp.where(jnp.isfinite(late), late, 0.0)
    along, curvature = (jnp.where(jnp.isfinite(a), a, 0.0) for a in (at.x, at.curvature))
    return PathRoot(z - along * late, x - curvature * late, residual, count)
