r"""Constraints of a path programme, their slopes, and the duration.

Unknowns are `b` at the nodes, at each point the squeeze `u` (along the direction of torques that does not accelerate)
and, on the sides of segment ends, the acceleration; and the margin `m`. With `b` and `a` at a point, torques are

    tau = pull (a - A_0 - A_b b) / |pull|^2 + squeeze u,      pull = (A_3, A_4),  squeeze . pull = 0,

and every constraint but the viscous torque is affine in `(b, a, u, m)`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from wholearm_jax.margin.path_programme import PathProgramme


class ChainUnknowns(NamedTuple):
    """Unknowns of a path programme, or a step in them (dimensionless)."""

    b: Float[Array, "nodes"]
    a: Float[Array, "points"]  # on sides only
    u: Float[Array, "points"]
    m: Float[Array, ""]


class ChainInequalities(NamedTuple):
    """A number for each inequality: its function, slack, multiplier, or a change of these."""

    rows: Float[Array, "rows points"]  # facets of friction cones, four torque limits, the sign of `a` at rest
    low: Float[Array, "nodes"]  # b >= 0
    high: Float[Array, "nodes"]  # b <= cap
    time: Float[Array, ""]  # duration <= the time allowed


class RowSlopes(NamedTuple):
    """Derivatives of the rows at each point, and the curvature in `b` of those that are concave in it."""

    b: Float[Array, "rows points"]
    a: Float[Array, "rows points"]
    u: Float[Array, "rows points"]
    curvature: Float[Array, "rows points"]


class DurationSlopes(NamedTuple):
    """Gradient of the duration with respect to `b`, and its tridiagonal Hessian; zero at fixed nodes."""

    gradient: Float[Array, "nodes"]
    diagonal: Float[Array, "nodes"]
    off_diagonal: Float[Array, "intervals"]


def point_values(p: PathProgramme, x: ChainUnknowns):
    """`b` and `a` at the points: of intervals from both nodes, on sides the node's `b` and an `a` of their own."""
    n = p.intervals
    left, right, side = x.b[:-1], x.b[1:], x.b[p.side_node]
    b = jnp.concatenate([(left + right) / 2, side])
    return b, jnp.concatenate([(right - left) / (2 * p.width), x.a[n:]])


def point_torque(p: PathProgramme, b, a, u) -> Float[Array, "2 points"]:
    """Torques without what viscous friction takes."""
    along, across = _torque_directions(p)
    return along * (a - p.acceleration[0] - p.acceleration[1] * b) + across * u


def point_force(p: PathProgramme, b, torque) -> Float[Array, "facets points"]:
    """Facets of the friction cones."""
    return p.force[:, 0] + p.force[:, 1] * b + p.force[:, 2] * torque[0] + p.force[:, 3] * torque[1]


def motor_torque(p: PathProgramme, b, torque) -> Float[Array, "2 points"]:
    """Torques of the motors: with what viscous friction takes."""
    return torque + p.viscous * speed(b)


def duration(p: PathProgramme, b) -> Float[Array, ""]:
    """Time that a profile takes: `sum 2 h / (v_k + v_k+1)`, exact for a constant acceleration."""
    v = speed(b)
    return (2 * p.width / (v[1:] + v[:-1])).sum()


def speed(b) -> Float[Array, "..."]:
    """Speed `sqrt(b)`, without a derivative at rest."""
    moving = b > 0
    return jnp.where(moving, jnp.sqrt(jnp.where(moving, b, 1.0)), 0.0)


def inequalities(p: PathProgramme, x: ChainUnknowns) -> ChainInequalities:
    """Inequality functions, positive inside; 1 for those that do not exist."""
    b, a = point_values(p, x)
    torque = point_torque(p, b, a, x.u)
    motor = motor_torque(p, b, torque)
    sign = _rest_sign(p)
    at_rest = jnp.where(sign != 0, sign * a, 1.0)
    rows = jnp.concatenate([point_force(p, b, torque) - x.m, 1 - motor, 1 + motor, at_rest[None]])
    timed = jnp.isfinite(p.duration)
    return ChainInequalities(
        jnp.where(p.is_live, rows, 1.0),
        jnp.where(p.is_fixed, 1.0, x.b),
        jnp.where(p.is_fixed, 1.0, p.cap - x.b),
        jnp.where(timed, jnp.where(timed, p.duration, 1.0) - duration(p, x.b), 1.0),
    )


def existing(p: PathProgramme, timed) -> ChainInequalities:
    """1 for each inequality that exists, 0 for the others; `timed` says whether the time is limited."""
    facets = p.force.shape[0]
    rows = jnp.where(p.is_live, jnp.ones((facets + 5, 1)), 0.0)
    rows = rows.at[-1].set(jnp.where(_rest_sign(p) != 0, rows[-1], 0.0))
    free = jnp.where(p.is_fixed, 0.0, 1.0)
    return ChainInequalities(rows, free, free, jnp.where(timed, 1.0, 0.0))


def row_slopes(p: PathProgramme, b) -> RowSlopes:
    """Slopes of the rows where the points have `b`."""
    along, across = _torque_directions(p)
    facets = p.force.shape[0]
    moving = b > 0
    v = jnp.sqrt(jnp.where(moving, b, 1.0))
    drag = jnp.where(moving, 0.5 / v, 0.0) * p.viscous
    bend = jnp.where(moving, -0.25 / v**3, 0.0) * p.viscous  # of 1 + motor; 1 - motor has the opposite sign

    def rows(torque, itself, sign):
        force = p.force[:, 2] * torque[0] + p.force[:, 3] * torque[1] + itself
        return jnp.where(p.is_live, jnp.concatenate([force, -torque, torque, sign[None]]), 0.0)

    none = jnp.zeros_like(b)
    by_b = rows(-along * p.acceleration[1], p.force[:, 1], none)
    by_b = by_b.at[facets : facets + 4].add(jnp.where(p.is_live, jnp.concatenate([-drag, drag]), 0.0))
    # Rows that are convex in `b` are linearised: the programme is solved by their tangents.
    concave = jnp.minimum(jnp.concatenate([-bend, bend]), 0.0)
    curvature = jnp.zeros_like(by_b).at[facets : facets + 4].set(jnp.where(p.is_live, concave, 0.0))
    return RowSlopes(by_b, rows(along, 0.0, _rest_sign(p)), rows(across, 0.0, none), curvature)


def duration_slopes(p: PathProgramme, b) -> DurationSlopes:
    """Derivatives of the duration, through those of the speeds `v = sqrt(b)` at the nodes."""
    v = jnp.sqrt(b)
    safe = jnp.where(p.is_fixed, 1.0, b)
    rate = jnp.where(p.is_fixed, 0.0, 0.5 / jnp.sqrt(safe))  # dv/db
    total = v[1:] + v[:-1]
    slope, bend = at_nodes(*(-2 * p.width / total**2,) * 2), 4 * p.width / total**3
    diagonal = at_nodes(bend, bend) * rate**2 - slope * rate / (2 * safe)
    return DurationSlopes(slope * rate, diagonal, bend * rate[1:] * rate[:-1])


def at_nodes(left: Float[Array, "intervals"], right: Float[Array, "intervals"]) -> Float[Array, "nodes"]:
    """Sum at each node what its intervals have at their left and at their right ends."""
    return jnp.pad(left, (0, 1)) + jnp.pad(right, (1, 0))


def _torque_directions(p: PathProgramme):
    """Torques that accelerate by one and no more than needed, and those that only squeeze."""
    pull = p.acceleration[2:]
    size = jnp.sqrt(jnp.where(p.is_live, (pull**2).sum(0), 1.0))
    return pull / size**2, jnp.stack([-pull[1], pull[0]]) / size


def _rest_sign(p: PathProgramme):
    """Sign that `a` must have at each point; 0: any."""
    return jnp.pad(p.side_sign, (p.intervals, 0))
