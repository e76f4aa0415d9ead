"""The upper bound on the margin of a phase: what torques within limits can do at each place of a path.

Unlike in `quasistatic`, the acceleration is free: the optimum is a vertex of a linear programme in `(tau1, tau2, m)`.
Derivation: section 8 of `docs/derivation.md`.
"""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin.contact_forces import MAX_ROLLING, cone_facets
from wholearm_jax.margin.quasistatic import affine_coefficients

BOUND_SPEEDS = 12  # intervals of speeds
MAX_SPEED_RATIO = 8.0  # largest speed that is covered [path lengths a duration]
BOUND_PLACES = 64  # intervals of the path between places


class MarginBound(eqx.Module):
    """An upper bound: no torque within limits keeps every slack above it for a whole phase."""

    value: Float[Array, ""]  # [N]
    s: Float[Array, ""]  # where it is attained
    path_fraction: Float[Array, ""]  # the same as a fraction of the path


def margin_upper_bound(
    dynamics: PathDynamics, duration: Float[Array, ""], from_rest=True, to_rest=True, rolling: int = MAX_ROLLING
) -> MarginBound:
    """Compute an upper bound on the margin of a phase.

    At each of many places the least slack is maximised over torques within limits and over speeds up to
    `MAX_SPEED_RATIO` path lengths a duration; in each interval of speeds every term takes its most favourable end, so
    that the bound errs upward. At rest the speed is 0, and the acceleration points forward at the start and backward at
    the end. The smallest of these maxima bounds the phase.

    Args:
        dynamics: Tabulated path dynamics.
        duration: Duration of the phase [s].
        from_rest: Whether it starts at rest.
        to_rest: Whether it ends at rest.
        rolling: Largest number of contacts that roll; a smaller one saves time.
    """
    max_speed = MAX_SPEED_RATIO * dynamics.length / duration
    speeds = max_speed * jnp.linspace(0.0, 1.0, BOUND_SPEEDS + 1) ** 2
    places = dynamics.breakpoints[0] + dynamics.length * jnp.linspace(0.0, 1.0, BOUND_PLACES + 1)
    motion, force = jax.vmap(partial(affine_coefficients, dynamics))(places)
    force = jax.vmap(partial(cone_facets, dynamics, rolling=rolling))(force)[:, None]
    at_rest, square, linear, slope = force[..., 0], force[..., 1], force[..., 2], force[..., 3:]
    # Bound the slacks of each interval of speeds; then both ends of the path at rest follow.
    low, high = speeds[:-1, None], speeds[1:, None]
    moving = at_rest + jnp.maximum(square * low**2, square * high**2) + jnp.maximum(linear * low, linear * high)
    ends, sign = jnp.array([0, BOUND_PLACES]), jnp.array([1.0, -1.0])
    count = moving.shape[0] * BOUND_SPEEDS
    best = jax.vmap(partial(_best_margin, dynamics.torque_limit))(
        jnp.concatenate([moving.reshape(count, -1), at_rest[ends, 0]]),
        jnp.concatenate([jnp.repeat(slope[:, 0], BOUND_SPEEDS, axis=0), slope[ends, 0]]),
        jnp.concatenate([jnp.zeros((count, 2)), sign[:, None] * motion[ends, 3:]]),
        jnp.concatenate([jnp.ones(count), sign * motion[ends, 0]]),
    )
    # The best speed of each place, and the worst place.
    values = best[:count].reshape(-1, BOUND_SPEEDS).max(1)
    values = values.at[ends].set(jnp.where(jnp.stack([from_rest, to_rest]), best[count:], values[ends]))
    k = jnp.argmin(values)
    return MarginBound(values[k], places[k], k / BOUND_PLACES)


def _vertices(slacks: int) -> Int[np.ndarray, "vertices 3"]:
    """List the triples of constraints (slacks, four limits, the acceleration's sign) that may meet in an optimum."""
    triples = itertools.combinations(range(slacks + 5), 3)
    return np.array([t for t in triples if t[0] < slacks])


def _best_margin(limit, offset, slope, acceleration_terms, acceleration_offset):
    """Maximise `m` with `offset + slope tau >= m`, `|tau| <= limit` and an acceleration that is not negative.

    The acceleration is `acceleration_terms . tau + acceleration_offset`. The optimum is one of the vertices.
    """
    # Rows (p, q) of the constraints `p . (tau1, tau2, m) + q >= 0`.
    box = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], offset.dtype)
    torque_columns = jnp.concatenate([slope, box, acceleration_terms[None]])
    margin_column = jnp.concatenate([-jnp.ones_like(offset), jnp.zeros(5, offset.dtype)])
    constant = jnp.concatenate([offset, limit[jnp.array([0, 0, 1, 1])], acceleration_offset[None]])
    scale = jnp.maximum(jnp.abs(torque_columns).max(1), 1e-300)
    rows = jnp.concatenate([torque_columns, margin_column[:, None]], axis=1)
    # Intersect each triple of planes by Cramer's rule.
    p = rows[_vertices(offset.shape[0])]
    q = constant[_vertices(offset.shape[0])]
    cross = jnp.cross(p[:, 1], p[:, 2])
    determinant = (p[:, 0] * cross).sum(1)
    size = jnp.prod(jnp.sqrt((p**2).sum(2)), axis=1)
    is_regular = jnp.abs(determinant) > 1e-9 * jnp.maximum(size, 1e-300)
    vertices = (
        -(q[:, :1] * cross + q[:, 1:2] * jnp.cross(p[:, 2], p[:, 0]) + q[:, 2:] * jnp.cross(p[:, 0], p[:, 1]))
        / jnp.where(is_regular, determinant, 1.0)[:, None]
    )
    # The best vertex that satisfies all constraints.
    slack = vertices @ rows.T + constant
    tolerance = 1e-9 * (jnp.abs(constant) + scale * jnp.abs(limit).max() + jnp.abs(vertices[:, 2:]))
    is_feasible = is_regular & jnp.all(slack >= -tolerance, axis=1)
    return jnp.where(is_feasible, vertices[:, 2], -jnp.inf).max()
