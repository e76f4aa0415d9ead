r"""Quasi-static torques: those within limits that give a motion at one place of a path with the largest least slack.

For a given motion the equation of motion `A3 tau1 + A4 tau2 = a - A0 - A1 v^2 - A2 v` leaves one free direction of the
torques: it changes the internal forces alone. Along it each force is linear, so that the best least slack lies where
two slacks meet or at a limit. A contact that rolls has three slacks: `c_n`, `mu c_n - c_t` and `mu c_n + c_t`.
Derivation: section 8 of `docs/derivation.md`.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin.contact_forces import cone_facets


class QuasistaticTorque(eqx.Module):
    """The best torques for a motion at one place."""

    torque: Float[Array, "2"]  # [N m]
    margin: Float[Array, ""]  # least slack [N]; -inf: no torque within limits gives this motion


def affine_coefficients(
    dynamics: PathDynamics, s: Float[Array, ""]
) -> tuple[Float[Array, "5"], Float[Array, "rows 5"]]:
    """Evaluate the coefficients of the acceleration and of the forces in `(1, v^2, v, tau1, tau2)` at `s`."""
    panel, xi = _locate(dynamics, s)
    return evaluate(dynamics.acceleration, panel, xi), evaluate(dynamics.force, panel, xi)


def acceleration_terms(dynamics: PathDynamics, s: Float[Array, ""]) -> Float[Array, "5"]:
    """Evaluate the coefficients of the acceleration at `s`."""
    return evaluate(dynamics.acceleration, *_locate(dynamics, s))


def _locate(dynamics: PathDynamics, s):
    """Find the panel and panel coordinate of `s`, in whichever segment it lies."""
    inner = dynamics.breakpoints[1:-1]
    return locate_panel(dynamics, jnp.minimum((s >= inner).sum(), dynamics.count - 1), s)


def best_quasistatic_torque(dynamics: PathDynamics, s, v=0.0, a=0.0) -> QuasistaticTorque:
    """Compute the torques that give a motion with the largest least slack, in closed form.

    Args:
        dynamics: Tabulated path dynamics.
        s: Place on the path.
        v: `ds/dt` there [1/s].
        a: `dv/dt` there [1/s^2].
    """
    # Torques that give the motion are `base + x direction`; slacks are then `offset + x slope`.
    motion, force = affine_coefficients(dynamics, s)
    force = cone_facets(dynamics, force)
    one = jnp.ones_like(s)
    speed = jnp.stack([one, v**2 * one, v * one])
    torque_terms = motion[3:]
    size = jnp.maximum(torque_terms @ torque_terms, 1e-300)
    base = torque_terms * (a - motion[:3] @ speed) / size
    direction = jnp.stack([-torque_terms[1], torque_terms[0]]) / jnp.sqrt(size)
    offset = force[:, :3] @ speed + force[:, 3:] @ base
    slope = force[:, 3:] @ direction
    # Limits of the torques bound `x`; a torque that does not depend on `x` must be within its limit.
    depends = jnp.abs(direction) > 1e-12
    safe = jnp.where(depends, direction, 1.0)
    ends = jnp.stack([(-dynamics.torque_limit - base) / safe, (dynamics.torque_limit - base) / safe])
    low = jnp.where(depends, ends.min(0), -jnp.inf).max()
    high = jnp.where(depends, ends.max(0), jnp.inf).min()
    is_within = depends | (jnp.abs(base) <= dynamics.torque_limit)
    # Try both ends and every place where two slacks meet.
    first, second = np.array(list(itertools.combinations(range(slope.shape[0]), 2))).T
    spread = slope[first] - slope[second]
    meets = jnp.where(spread != 0, (offset[second] - offset[first]) / jnp.where(spread != 0, spread, 1.0), low)
    x = jnp.clip(jnp.concatenate([jnp.stack([low, high]), meets]), low, high)
    least = (offset + x[:, None] * slope).min(1)
    best = jnp.argmax(least)
    is_possible = (low <= high) & jnp.all(is_within) & jnp.all(jnp.isfinite(least))
    return QuasistaticTorque(base + x[best] * direction, jnp.where(is_possible, least[best], -jnp.inf))


def best_quasistatic_torque_batch(dynamics: PathDynamics, s, v, a) -> QuasistaticTorque:
    """Compute `best_quasistatic_torque` at many places."""
    return jax.vmap(best_quasistatic_torque, (None, 0, 0, 0))(dynamics, s, v, a)
