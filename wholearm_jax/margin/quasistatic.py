r"""Quasi-static torques and the bound: what torques within limits can do at one place of the wire.

For a given motion the equation of motion `A3 tau1 + A4 tau2 = a - A0 - A1 v^2 - A2 v` leaves one free direction of the
torques, the squeeze. Along it each force is linear, so the best least force lies where two forces meet or at a limit.
The bound lets the acceleration go free as well; its optimum is a vertex of a linear programme in `(tau1, tau2, m)`.
Of a contact that rolls, three linear functions of the torque count: `c_n`, `mu c_n - c_t` and `mu c_n + c_t`.

Derivation: section 8 of `docs/derivation.md`.
"""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin.contact_forces import MAX_ROLLING, cone_facets

BOUND_SPEEDS = 12  # speed intervals of the bound
MAX_SPEED_RATIO = 8.0  # it covers speeds up to this many wire lengths a duration
BOUND_PLACES = 64


class QuasistaticTorque(eqx.Module):
    """The best torques for a motion at one place: `torque` [N m], least slack `margin` [N] (-inf: outside limits)."""

    torque: Float[Array, "2"]
    margin: Float[Array, ""]


class MarginBound(eqx.Module):
    """No torque within limits keeps every slack above `value` [N] for a whole phase: `s` and `path_fraction` of the
    wire say
    where it is tight."""

    value: Float[Array, ""]
    s: Float[Array, ""]
    path_fraction: Float[Array, ""]


def affine_coefficients(dynamics: PathDynamics, s: Float[Array, ""]):
    """Coefficients of `a` (5) and of the forces (slots x 5) at `s`, in the piece that holds it."""
    panel, xi = _place(dynamics, s)
    return evaluate(dynamics.acceleration, panel, xi), evaluate(dynamics.force, panel, xi)


def acceleration_terms(dynamics: PathDynamics, s: Float[Array, ""]) -> Float[Array, "5"]:
    """Those of `a` alone."""
    return evaluate(dynamics.acceleration, *_place(dynamics, s))


def _place(dynamics: PathDynamics, s):
    inner = dynamics.breakpoints[1:-1]
    return locate_panel(dynamics, jnp.minimum((s >= inner).sum(), dynamics.count - 1), s)


def best_quasistatic_torque(dynamics: PathDynamics, s, v=0.0, a=0.0) -> QuasistaticTorque:
    """Torques that give the motion `(v, a)` at `s` [1/s, 1/s^2] with the largest least slack, in closed form."""
    motion, force = affine_coefficients(dynamics, s)
    force = cone_facets(dynamics, force)
    one = jnp.ones_like(s)
    speed = jnp.stack([one, v**2 * one, v * one])
    pull = motion[3:]
    size = jnp.maximum(pull @ pull, 1e-300)
    base = pull * (a - motion[:3] @ speed) / size
    free = jnp.stack([-pull[1], pull[0]]) / jnp.sqrt(size)
    offset = force[:, :3] @ speed + force[:, 3:] @ base
    slope = force[:, 3:] @ free
    steep = jnp.abs(free) > 1e-12
    safe = jnp.where(steep, free, 1.0)
    ends = jnp.stack([(-dynamics.torque_limit - base) / safe, (dynamics.torque_limit - base) / safe])
    low = jnp.where(steep, ends.min(0), -jnp.inf).max()
    high = jnp.where(steep, ends.max(0), jnp.inf).min()
    one_side, other = np.array(list(itertools.combinations(range(slope.shape[0]), 2))).T
    spread = slope[one_side] - slope[other]
    meets = jnp.where(spread != 0, (offset[other] - offset[one_side]) / jnp.where(spread != 0, spread, 1.0), low)
    tries = jnp.clip(jnp.concatenate([jnp.stack([low, high]), meets]), low, high)
    least = (offset + tries[:, None] * slope).min(1)
    best = jnp.argmax(least)
    within = steep | (jnp.abs(base) <= dynamics.torque_limit)  # a torque that is the same along all of the squeeze
    possible = (low <= high) & jnp.all(within) & jnp.all(jnp.isfinite(least))
    margin = jnp.where(possible, least[best], -jnp.inf)
    return QuasistaticTorque(base + tries[best] * free, margin)


def best_quasistatic_torque_batch(dynamics: PathDynamics, s, v, a) -> QuasistaticTorque:
    """`best_quasistatic_torque` at many places."""
    return jax.vmap(best_quasistatic_torque, (None, 0, 0, 0))(dynamics, s, v, a)


def margin_upper_bound(
    dynamics: PathDynamics, duration: Float[Array, ""], from_rest=True, to_rest=True, rolling: int = MAX_ROLLING
) -> MarginBound:
    """An upper bound on the margin of a phase along a wire that starts, and ends, at rest or moving.

    At each of many places the least slack is maximised over torques within limits and over speeds up to
    `MAX_SPEED_RATIO` wire
    lengths a duration (each interval of speeds by its most favourable corner, so that the bound errs upward); at rest
    speed is 0 and the acceleration may point only forward (start) or backward (end). The smallest of these bounds the
    phase. What no more than `rolling` contacts can need is left out: without any, it takes less than half the time.
    """
    fastest = MAX_SPEED_RATIO * dynamics.length / duration
    speeds = fastest * jnp.linspace(0.0, 1.0, BOUND_SPEEDS + 1) ** 2
    places = dynamics.breakpoints[0] + dynamics.length * jnp.linspace(0.0, 1.0, BOUND_PLACES + 1)
    motion, force = jax.vmap(partial(affine_coefficients, dynamics))(places)
    force = jax.vmap(partial(cone_facets, dynamics, rolling=rolling))(force)[:, None]
    still, square, linear, slope = force[..., 0], force[..., 1], force[..., 2], force[..., 3:]

    low, high = speeds[:-1, None], speeds[1:, None]
    moving = still + jnp.maximum(square * low**2, square * high**2) + jnp.maximum(linear * low, linear * high)
    ends, sign = jnp.array([0, BOUND_PLACES]), jnp.array([1.0, -1.0])
    count = moving.shape[0] * BOUND_SPEEDS
    best = jax.vmap(partial(_best, dynamics))(
        jnp.concatenate([moving.reshape(count, -1), still[ends, 0]]),
        jnp.concatenate([jnp.repeat(slope[:, 0], BOUND_SPEEDS, axis=0), slope[ends, 0]]),
        jnp.concatenate([jnp.zeros((count, 2)), sign[:, None] * motion[ends, 3:]]),
        jnp.concatenate([jnp.ones(count), sign * motion[ends, 0]]),
    )
    values = best[:count].reshape(-1, BOUND_SPEEDS).max(1)
    values = values.at[ends].set(jnp.where(jnp.stack([from_rest, to_rest]), best[count:], values[ends]))
    k = jnp.argmin(values)
    return MarginBound(values[k], places[k], k / BOUND_PLACES)


def _rows(slacks: int) -> Int[np.ndarray, "vertices 3"]:
    """Triples of the constraints (slacks, four limits, the acceleration's sign) that may meet in an optimum."""
    triples = itertools.combinations(range(slacks + 5), 3)
    return np.array([t for t in triples if t[0] < slacks])


def _best(dynamics, offset, slope, pull, push):
    """Largest `m` with `offset + slope tau >= m`, `|tau| <= limit` and `pull.tau + push >= 0`, by its vertices."""
    limit = dynamics.torque_limit
    one, none = jnp.ones_like(offset), jnp.zeros(5, offset.dtype)
    # Row (p, q): p.(tau1, tau2, m) + q >= 0.
    box = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], offset.dtype)
    rows = jnp.concatenate([slope, box, pull[None]])
    last = jnp.concatenate([-one, none])
    constant = jnp.concatenate([offset, limit[jnp.array([0, 0, 1, 1])], push[None]])
    scale = jnp.maximum(jnp.abs(rows).max(1), 1e-300)
    p = jnp.concatenate([rows, last[:, None]], axis=1)
    triples = p[_rows(offset.shape[0])]
    q = constant[_rows(offset.shape[0])]
    cross = jnp.cross(triples[:, 1], triples[:, 2])
    det = (triples[:, 0] * cross).sum(1)
    size = jnp.prod(jnp.sqrt((triples**2).sum(2)), axis=1)
    regular = jnp.abs(det) > 1e-9 * jnp.maximum(size, 1e-300)
    meet = (
        -(
            q[:, :1] * cross
            + q[:, 1:2] * jnp.cross(triples[:, 2], triples[:, 0])
            + q[:, 2:] * jnp.cross(triples[:, 0], triples[:, 1])
        )
        / jnp.where(regular, det, 1.0)[:, None]
    )
    slack = meet @ p.T + constant
    allowed = 1e-9 * (jnp.abs(constant) + scale * jnp.abs(limit).max() + jnp.abs(meet[:, 2:]))
    feasible = regular & jnp.all(slack >= -allowed, axis=1)
    return jnp.where(feasible, meet[:, 2], -jnp.inf).max()
