r"""Solve a path programme: a primal-dual interior point whose linear systems are tridiagonal.

With inequality functions `r` (`chain_constraints`) and the duration `t(b)`, which is convex,

    maximise m   subject to   r(b, a, u, m) >= 0,   0 <= b <= cap,   t(b) <= T        (the largest margin), or
    minimise t(b)   subject to   the same with a given m and any T                    (the shortest time).

Each Newton step eliminates `u` (and the sides' `a`) point by point, which leaves a tridiagonal system in `b`, bordered
by `m` and the multiplier `eta` of the duration:

    [ K    k_m   t' ] [ db  ]   [ f_b ]
    [ k_m' k_mm  0  ] [ dm  ] = [ f_m ]
    [ t''  0  -w/eta] [ eta ]   [ f_t ]

For the shortest time `m` is given, `eta` is one, and the border goes. Which of the two is asked for is data, so that
one program solves both. Mehrotra's predictor and corrector choose the barrier parameter.

Derivation: section 8 of `docs/derivation.md`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.margin.chain_constraints import (
    ChainInequalities,
    ChainUnknowns,
    RowSlopes,
    at_nodes,
    duration,
    duration_slopes,
    existing,
    inequalities,
    motor_torque,
    point_torque,
    point_values,
    row_slopes,
)
from wholearm_jax.margin.path_programme import PathProgramme

GAP_TOLERANCE = 1e-9  # sum of slacks times multipliers, in force units (or units of time)
RESIDUAL_TOLERANCE = 1e-8
RESIDUAL_FRACTION = 1e-4  # the barrier parameter stays above this times the residual: feasibility first
FIRST_SLACK = 0.1  # least slack to begin with


class ChainEffort(NamedTuple):
    """How many iterations are allowed, and how long their steps may be: joints of much viscous friction need many."""

    iterations: int | Int[Array, ""] = 100
    to_boundary: float | Float[Array, ""] = 0.99  # fraction of the step to the nearest bound


class ChainSolution(eqx.Module):
    """Optimum of a path programme, dimensionless, with the multipliers of its inequalities."""

    unknowns: ChainUnknowns
    multipliers: ChainInequalities
    motor_torque: Float[Array, "2 points"]
    duration: Float[Array, ""]
    gap: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class _Iterate(NamedTuple):
    """Loop state."""

    x: ChainUnknowns
    slack: ChainInequalities
    multiplier: ChainInequalities
    gap: Float[Array, ""]
    residual: Float[Array, ""]
    count: Int[Array, ""]


class _PointHessian(NamedTuple):
    """Second derivatives at each point in `(b, a, u)` and `m`; `k..` are without `u`."""

    bu: Float[Array, "points"]
    au: Float[Array, "points"]
    uu: Float[Array, "points"]
    kbb: Float[Array, "points"]
    kba: Float[Array, "points"]
    kaa: Float[Array, "points"]


class _NewtonSystem(NamedTuple):
    """Factors of one iteration's linear system, which predictor and corrector share."""

    # Inequalities
    live: ChainInequalities  # 1: exists
    missing: ChainInequalities  # function minus slack
    weight: ChainInequalities  # multiplier over slack
    slopes: RowSlopes
    timed: Bool[Array, ""]  # the time is limited
    fast: Bool[Array, ""]  # the time is to be the shortest
    # Points
    hessian: _PointHessian
    margin_a: Float[Array, "points"]  # column of m, without u
    margin_u: Float[Array, "points"]
    # Tridiagonal matrix and its border
    pivot: Float[Array, "nodes"]
    ratio: Float[Array, "intervals"]
    margin_column: Float[Array, "nodes"]
    time_column: Float[Array, "nodes"]
    margin_corner: Float[Array, ""]
    time_corner: Float[Array, ""]
    solved_margin: Float[Array, "nodes"]
    solved_time: Float[Array, "nodes"]


def solve_chain(
    programme: PathProgramme, margin: float | Float[Array, ""], effort: ChainEffort = ChainEffort()
) -> ChainSolution:
    """Solve a path programme for the largest margin, or for the shortest time with a margin.

    Args:
        programme: Discretised problem, with any time where a margin is given.
        margin: Margin, in force units, to be kept in the shortest time; NaN for the largest margin.
        effort: How many iterations, and how long steps.
    """
    p, margin = stop_gradient((programme, margin))
    fast = ~jnp.isnan(margin)
    x = _first_guess(p, margin)
    value = inequalities(p, x)
    slack = ChainInequalities(*(jnp.maximum(r, FIRST_SLACK) for r in value))
    allowed = jnp.where(jnp.isfinite(p.duration), p.duration, 1.0)
    slack = slack._replace(low=jnp.maximum(value.low, 1e-6), time=jnp.maximum(value.time, FIRST_SLACK * allowed))
    multiplier = ChainInequalities(*(jnp.clip(0.01 / r, 1e-4, 1e2) for r in slack))

    def going(at: _Iterate):
        fine = (at.gap <= GAP_TOLERANCE) & (at.residual <= RESIDUAL_TOLERANCE)
        return (at.count < effort.iterations) & ~fine & jnp.isfinite(at.gap)

    far = jnp.asarray(1e30, x.b.dtype)
    first = _Iterate(x, slack, multiplier, far, far, jnp.asarray(0))
    at = jax.lax.while_loop(going, lambda at: _iterate(p, at, fast, effort.to_boundary), first)
    b, a = point_values(p, at.x)
    torque = motor_torque(p, b, point_torque(p, b, a, at.x.u))
    fine = (at.gap <= 1e3 * GAP_TOLERANCE) & (at.residual <= 10 * RESIDUAL_TOLERANCE)
    return ChainSolution(at.x, at.multiplier, torque, duration(p, at.x.b), at.gap, at.residual, at.count, fine)


def lagrangian(p: PathProgramme, solution: ChainSolution, margin: float | Float[Array, ""]) -> Float[Array, ""]:
    """Lagrangian of the largest margin, or (given a `margin`) of the shortest time, at a solution that is held fixed.

    Its derivatives with respect to the programme and the margin are those of the optimum (envelope theorem).
    """
    solution = stop_gradient(solution)
    x, multiplier = solution.unknowns, solution.multipliers
    fast = ~jnp.isnan(margin)
    live = existing(p, jnp.isfinite(p.duration) & ~fast)
    x = x._replace(b=jnp.where(p.is_fixed, p.end_b, x.b), m=jnp.where(fast, margin, x.m))
    value = inequalities(p, x)
    terms = zip(live, multiplier, value, strict=True)
    gained = sum(jnp.where(one > 0, z * r, 0.0).sum() for one, z, r in terms)
    return jnp.where(fast, duration(p, x.b) - gained, x.m + gained)


def _first_guess(p: PathProgramme, margin) -> ChainUnknowns:
    """A profile that is zero at ends at rest and about as fast as needed, no squeeze, and a margin that is kept."""
    fraction = jnp.pad(jnp.cumsum(p.width), (1, 0))
    rest = p.is_fixed[jnp.array([0, p.intervals])]
    shape = jnp.where(rest[0], fraction, 1.0) * jnp.where(rest[1], 1 - fraction, 1.0)
    shape = jnp.where(p.is_fixed, 0.0, jnp.maximum(shape, 1e-12))
    faster = (duration(p, shape) / (0.7 * p.duration)) ** 2
    b = jnp.minimum(jnp.clip(faster, 0.1, 4.0) * shape, p.cap / 2)
    zero = jnp.zeros(p.s.shape[0], b.dtype)
    x = ChainUnknowns(jnp.where(p.is_fixed, p.end_b, b), zero, zero, jnp.zeros((), b.dtype))
    below = inequalities(p, x).rows[: p.force.shape[0]].min() - 0.5
    return x._replace(m=jnp.where(jnp.isnan(margin), below, margin))


def _iterate(p: PathProgramme, at: _Iterate, fast, to_boundary) -> _Iterate:
    """Predict without a barrier, choose the barrier parameter by how far that step goes, correct, and step."""
    system = _assemble(p, at, fast)
    live, slack, multiplier = system.live, at.slack, at.multiplier
    count = sum(one.sum() for one in live)
    barrier = _product(live, slack, multiplier) / count

    # Predictor (without a barrier) and corrector: two passes of one loop, which is compiled once.
    def improve(_, before):
        _, ds, dz, level = before
        target = ChainInequalities(*(level - d * e for d, e in zip(ds, dz, strict=True)))
        dx, ds, dz = _direction(p, at, system, target)
        slack_ahead = _moved(slack, ds, _feasible_fraction(slack, ds))
        multiplier_ahead = _moved(multiplier, dz, _feasible_fraction(multiplier, dz))
        sigma = jnp.clip((_product(live, slack_ahead, multiplier_ahead) / count / barrier) ** 3, 1e-4, 1.0)
        level = jnp.maximum(sigma * barrier, jnp.minimum(barrier, RESIDUAL_FRACTION * at.residual))
        return dx, ds, dz, level

    none = jax.tree.map(jnp.zeros_like, (at.x, slack, slack, barrier))
    dx, ds, dz, _ = jax.lax.fori_loop(0, 2, improve, none)
    primal = jnp.minimum(1.0, to_boundary * _feasible_fraction(slack, ds))
    dual = jnp.minimum(1.0, to_boundary * _feasible_fraction(multiplier, dz))
    nonlinear, both = system.timed | fast, jnp.minimum(primal, dual)
    primal, dual = jnp.where(nonlinear, both, primal), jnp.where(nonlinear, both, dual)
    x, slack, multiplier = _moved(at.x, dx, primal), _moved(slack, ds, primal), _moved(multiplier, dz, dual)

    terms = zip(live, inequalities(p, x), slack, strict=True)
    residual = jnp.stack([jnp.abs(one * (r - s)).max() for one, r, s in terms]).max()
    return _Iterate(x, slack, multiplier, jnp.asarray(_product(live, slack, multiplier)), residual, at.count + 1)


def _assemble(p: PathProgramme, at: _Iterate, fast) -> _NewtonSystem:
    """Reduce the Newton system to the nodes and factor it."""
    n, facets = p.intervals, p.force.shape[0]
    timed = jnp.isfinite(p.duration) & ~fast
    live = existing(p, timed)
    value = inequalities(p, at.x)
    missing = ChainInequalities(*(one * (r - s) for one, r, s in zip(live, value, at.slack, strict=True)))
    triples = zip(live, at.multiplier, at.slack, strict=True)
    weight = ChainInequalities(*(one * z / s for one, z, s in triples))
    slopes = row_slopes(p, point_values(p, at.x)[0])
    hessian = _point_hessian(p, weight.rows, at.multiplier.rows, slopes)

    # Border of the margin: its column is -1 in the facets' rows.
    of_facets = weight.rows[:facets]
    by_b, by_a, by_u = (-(of_facets * d[:facets]).sum(0) for d in slopes[:3])
    margin_column, margin_a = _reduce(p, hessian, by_b, by_a, by_u)
    corner = of_facets.sum() - (by_u**2 / hessian.uu).sum() - (margin_a[n:] ** 2 / hessian.kaa[n:]).sum()

    # Tridiagonal matrix of the nodes.
    time = duration_slopes(p, at.x.b)
    eta = jnp.where(fast, 1.0, jnp.where(timed, at.multiplier.time, 0.0))
    inverse = 1 / (2 * p.width)
    square, mixed, rate = hessian.kbb[:n] / 4, hessian.kba[:n] * inverse, hessian.kaa[:n] * inverse**2
    diagonal = at_nodes(square - mixed + rate, square + mixed + rate) + weight.low + weight.high + eta * time.diagonal
    side = hessian.kbb[n:] - hessian.kba[n:] ** 2 / hessian.kaa[n:]
    diagonal = jnp.where(p.is_fixed, 1.0, diagonal.at[p.side_node].add(side))
    off = square - rate + eta * time.off_diagonal
    pivot, ratio = _factor(diagonal, jnp.where(p.is_fixed[1:] | p.is_fixed[:-1], 0.0, off))
    solved = _solve(pivot, ratio, jnp.stack([margin_column, time.gradient]))
    return _NewtonSystem(
        live=live,
        missing=missing,
        weight=weight,
        slopes=slopes,
        timed=timed,
        fast=fast,
        hessian=hessian,
        margin_a=margin_a,
        margin_u=by_u,
        pivot=pivot,
        ratio=ratio,
        margin_column=margin_column,
        time_column=time.gradient,
        margin_corner=corner,
        time_corner=-at.slack.time / at.multiplier.time,
        solved_margin=solved[0],
        solved_time=solved[1],
    )


def _point_hessian(p: PathProgramme, weight, multiplier, slopes: RowSlopes) -> _PointHessian:
    """Sum the rows' products of slopes at each point, and eliminate `u`."""
    wb, wa, wu = (weight * d for d in slopes[:3])
    bb = (wb * slopes.b).sum(0) - (multiplier * slopes.curvature).sum(0)
    ba, aa = (wb * slopes.a).sum(0), (wa * slopes.a).sum(0)
    bu, au, uu = (wb * slopes.u).sum(0), (wa * slopes.u).sum(0), (wu * slopes.u).sum(0)
    uu, aa = jnp.where(p.is_live, uu, 1.0), jnp.where(p.is_live, aa, 1.0)
    return _PointHessian(bu, au, uu, bb - bu**2 / uu, ba - bu * au / uu, aa - au**2 / uu)


def _reduce(p: PathProgramme, hessian: _PointHessian, by_b, by_a, by_u):
    """A column in `(b, a, u)` at the points without the eliminated unknowns: at the nodes; and its `a`, without `u`."""
    n = p.intervals
    by_b, by_a = by_b - hessian.bu / hessian.uu * by_u, by_a - hessian.au / hessian.uu * by_u
    side = by_b[n:] - hessian.kba[n:] / hessian.kaa[n:] * by_a[n:]
    half, rate = by_b[:n] / 2, by_a[:n] / (2 * p.width)
    return jnp.where(p.is_fixed, 0.0, at_nodes(half - rate, half + rate).at[p.side_node].add(side)), by_a


def _direction(p: PathProgramme, at: _Iterate, system: _NewtonSystem, target: ChainInequalities):
    """Steps of unknowns, slacks and multipliers towards products `target` of slacks and multipliers."""
    n, facets, hessian, slopes, live = p.intervals, p.force.shape[0], system.hessian, system.slopes, system.live

    # Right-hand side.
    terms = zip(live, target, at.slack, system.weight, system.missing, strict=True)
    g = ChainInequalities(*(one * t / s - w * q for one, t, s, w, q in terms))
    by_b, by_a, by_u = ((g.rows * d).sum(0) for d in slopes[:3])
    right, reduced_a = _reduce(p, hessian, by_b, by_a, by_u)
    right = right + jnp.where(p.is_fixed, 0.0, g.low - g.high) - jnp.where(system.fast, system.time_column, 0.0)
    solved = _solve(system.pivot, system.ratio, right[None])[0]

    # Border: the step of the margin and the new multiplier of the duration.
    side = (system.margin_a[n:] * reduced_a[n:] / hessian.kaa[n:]).sum()
    f_m = 1 - g.rows[:facets].sum() - (system.margin_u * by_u / hessian.uu).sum() - side
    f_m = f_m - system.margin_column @ solved
    f_t = -target.time / at.multiplier.time + system.missing.time - system.time_column @ solved
    mm = system.margin_corner - system.margin_column @ system.solved_margin
    mt = -system.margin_column @ system.solved_time
    tt = system.time_corner - system.time_column @ system.solved_time
    determinant = mm * tt - mt**2
    dm = jnp.where(system.timed, (f_m * tt - mt * f_t) / determinant, f_m / mm)
    dm = jnp.where(system.fast, 0.0, dm)
    eta = jnp.where(system.timed, (mm * f_t - mt * f_m) / determinant, 0.0)

    # Back to the points, then slacks and multipliers.
    db = solved - system.solved_margin * dm - system.solved_time * eta
    b, a = point_values(p, ChainUnknowns(db, jnp.zeros_like(by_a), by_u, dm))
    a = a.at[n:].set(((reduced_a - hessian.kba * b - system.margin_a * dm) / hessian.kaa)[n:])
    u = (by_u - hessian.bu * b - hessian.au * a - system.margin_u * dm) / hessian.uu
    change = (slopes.b * b + slopes.a * a + slopes.u * u).at[:facets].add(-dm)
    change = ChainInequalities(change, db, -db, -system.time_column @ db)
    ds = ChainInequalities(*(one * (q + d) for one, q, d in zip(live, system.missing, change, strict=True)))
    terms = zip(live, target, at.slack, at.multiplier, system.weight, ds, strict=True)
    dz = ChainInequalities(*(one * (t / s - z - w * d) for one, t, s, z, w, d in terms))
    dz = dz._replace(time=jnp.where(system.timed, eta - at.multiplier.time, 0.0))
    return ChainUnknowns(db, jnp.where(jnp.arange(a.shape[0]) < n, 0.0, a), u, dm), ds, dz


def _product(live: ChainInequalities, slack: ChainInequalities, multiplier: ChainInequalities):
    """Sum of slacks times multipliers."""
    return sum((one * s * z).sum() for one, s, z in zip(live, slack, multiplier, strict=True))


def _moved(values, steps, fraction):
    """Values after a fraction of a step."""
    return type(values)(*(v + fraction * d for v, d in zip(values, steps, strict=True)))


def _feasible_fraction(values: ChainInequalities, steps: ChainInequalities):
    """Largest fraction of a step, at most 1, that leaves no value negative."""
    shrink = jnp.stack([(-d / v).max() for v, d in zip(values, steps, strict=True)]).max()
    return 1 / jnp.maximum(shrink, 1.0)


def _factor(diagonal: Float[Array, "nodes"], off: Float[Array, "intervals"]):
    """Pivots and ratios of `L D L^T` of a symmetric tridiagonal matrix."""

    def eliminate(pivot, row):
        d, o = row
        ratio = o / pivot
        return d - ratio * o, (d - ratio * o, ratio)

    _, (pivots, ratios) = jax.lax.scan(eliminate, diagonal[0], (diagonal[1:], off))
    return jnp.append(diagonal[:1], pivots), ratios


def _solve(pivot: Float[Array, "nodes"], ratio: Float[Array, "intervals"], right: Float[Array, "columns nodes"]):
    """Solve with these factors."""

    def substitute(before, row):
        r, q = row
        return (r - q * before,) * 2

    right = right.T
    _, down = jax.lax.scan(substitute, right[0], (right[1:], ratio))
    down = jnp.concatenate([right[:1], down]) / pivot[:, None]
    _, up = jax.lax.scan(substitute, down[-1], (down[:-1], ratio), reverse=True)
    return jnp.concatenate([up, down[-1:]]).T
