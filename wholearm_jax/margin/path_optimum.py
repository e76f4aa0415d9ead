"""The largest margin over all motions along a path, and the shortest time with a margin, in SI units.

Derivation: section 8 of `docs/derivation.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import LOOPS_AS_KERNELS, CachedJit, as_device_array
from wholearm_jax.dynamics import PathDynamics, evaluate_dot, locate_panel
from wholearm_jax.margin.chain_interior_point import ChainEffort, ChainSolution, lagrangian, solve_chain
from wholearm_jax.margin.contact_forces import MAX_ROLLING
from wholearm_jax.margin.path_programme import PathProgramme, SpeedRange, discretise

PROGRAMME_INTERVALS = 200
MORE_EFFORT = ChainEffort(iterations=600, to_boundary=0.9)


class PathOptimum(eqx.Module):
    """The best motion along a path; `margin` and `duration` carry derivatives, all else is held fixed.

    Points are the midpoints of the intervals between nodes.
    """

    margin: Float[Array, ""]  # [N]
    duration: Float[Array, ""]  # [s]
    # Motion
    node_s: Float[Array, "nodes"]
    time: Float[Array, "nodes"]  # [s]
    speed: Float[Array, "nodes"]  # ds/dt [1/s]
    point_s: Float[Array, "points"]
    torque: Float[Array, "points 2"]  # [N m]
    force: Float[Array, "points rows"]  # [N]
    # What binds
    facet_weight: Float[
        Array, "facets"
    ]  # multipliers of each facet of the friction cones, all in all 1 (`cone_facets`)
    limit_gain: Float[Array, "2"]  # growth of the margin with each torque limit, times the limit [N]
    time_gain: Float[Array, ""]  # growth of the margin with the time allowed [N/s]
    hardest_s: Float[Array, ""]  # where the facets weigh most
    # Solver
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


def solve_path(
    dynamics: PathDynamics,
    duration: Float[Array, ""],
    margin: Float[Array, ""],
    speeds: SpeedRange,
    intervals: int = PROGRAMME_INTERVALS,
    rolling: int = MAX_ROLLING,
    effort: ChainEffort = ChainEffort(),
) -> PathOptimum:
    """Return the motion with the largest margin under any torque within limits, or the fastest with a given one.

    Args:
        dynamics: tabulated path dynamics.
        duration: time allowed [s]; infinite for any, and where a margin is given.
        margin: margin to be kept by the fastest motion [N]; NaN for the largest. Multipliers are then those of the
            time: `facet_weight` sums to its growth with the margin, in their units.
        speeds: speeds allowed at the ends and on the way.
        intervals: number of intervals; the error falls with its square.
        rolling: largest number of rolling contacts that the formation may have.
        effort: of the interior point.

    Returns:
        The optimum; not `converged` where no motion takes so little time, or has such a margin.
    """
    programme = discretise(dynamics, duration, speeds, intervals, rolling)
    kept = margin / programme.force_unit
    solution = solve_chain(programme, kept, effort)
    value = lagrangian(programme, solution, kept)
    fast = ~jnp.isnan(margin)
    best_margin = jnp.where(fast, margin, value * programme.force_unit)
    best_duration = jnp.where(fast, value, solution.duration) * programme.time_unit
    return _in_si_units(dynamics, programme, solution, best_margin, best_duration)


def largest_margin(
    dynamics: PathDynamics,
    duration: Float[Array, ""],
    speeds: SpeedRange,
    rolling: int = MAX_ROLLING,
    intervals: int = PROGRAMME_INTERVALS,
) -> PathOptimum:
    """Return the motion with the largest margin in a duration; see `solve_path`."""
    return _solve(dynamics, duration, as_device_array(np.nan), speeds, intervals, rolling)


def shortest_duration(
    dynamics: PathDynamics, margin: Float[Array, ""], speeds: SpeedRange, rolling: int = MAX_ROLLING
) -> PathOptimum:
    """Return the fastest motion with a margin; see `solve_path`."""
    return _solve(dynamics, as_device_array(np.inf), margin, speeds, PROGRAMME_INTERVALS, rolling)


def _solve(*problem) -> PathOptimum:
    """Solve a path's programme, with more effort where the usual one does not suffice."""
    for effort in (ChainEffort(), MORE_EFFORT):
        found = _solve_path(*problem, jax.tree.map(as_device_array, effort))
        if found.converged:
            break
    return found


_solve_path = CachedJit(solve_path, compiler_options=LOOPS_AS_KERNELS)


def _in_si_units(dynamics: PathDynamics, p: PathProgramme, solution: ChainSolution, margin, duration) -> PathOptimum:
    dynamics, p, solution = stop_gradient((dynamics, p, solution))
    n, facets = p.intervals, p.force.shape[0]
    b, multiplier = solution.unknowns.b, solution.multipliers
    root = jnp.sqrt(b)
    v = jnp.sqrt((b[1:] + b[:-1]) / 2) * p.speed_unit[:n]
    torque = (solution.motor_torque[:, :n] * dynamics.torque_limit[:, None]).T
    terms = jnp.concatenate([jnp.stack([jnp.ones_like(v), v**2, v], axis=1), torque], axis=1)

    def force(segment, s, terms):
        return evaluate_dot(dynamics.force, *locate_panel(dynamics, segment, s), terms)

    weights = jnp.where(p.is_live, multiplier.rows, 0.0)
    limits = weights[facets : facets + 4].sum(1)
    timed = jnp.isfinite(p.duration)
    return PathOptimum(
        margin=margin,
        duration=duration,
        node_s=p.node_s,
        time=jnp.pad(jnp.cumsum(2 * p.width / (root[1:] + root[:-1])), (1, 0)) * p.time_unit,
        speed=root * jnp.append(p.speed_unit[:n], p.speed_unit[n - 1]),
        point_s=p.s[:n],
        torque=torque,
        force=jax.vmap(force)(p.segment[:n], p.s[:n], terms),
        facet_weight=weights[:facets].sum(1),
        limit_gain=(limits[:2] + limits[2:]) * p.force_unit,
        time_gain=jnp.where(timed, multiplier.time, 0.0) * p.force_unit / p.time_unit,
        hardest_s=p.s[jnp.argmax(weights[:facets].sum(0))],
        converged=solution.converged,
        iterations=solution.iterations,
    )
