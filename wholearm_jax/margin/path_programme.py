r"""Discretise the problem of the largest margin over all motions along a path: a convex programme of a chain.

With `b = v^2` as the unknown, `a = b'/2`, the equation of motion and the contact forces are affine in `(b, a, tau)`.
`b` is linear on each of `n` intervals, so that `a` is constant; constraints hold at the intervals' midpoints, and on
both sides of every end of a path segment, where coefficients jump and where a motion from or to rest is hardest. The
viscous torques act where the motors do, on the joints: with `tau + c v` in place of `tau` (`viscous` below) they count
in the torque limits only.

Derivation: section 8 of `docs/derivation.md`.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin.contact_forces import MAX_ROLLING, cone_facets

GRADING = 0.5  # 0: nodes evenly spaced in each segment; 1: at Chebyshev's places, dense at its ends
MIN_INTERVALS = 2  # of a segment
SHORT_SEGMENT = 1e-6  # of the path, below which a segment has no intervals of its own: they would be mere rounding
LEAST_UNIT = 1e-3  # of force, over the largest that torques at their limits exert
SPEED_CAP = 100.0  # largest b in units of path length times largest acceleration, where nothing else limits it


class PathProgramme(eqx.Module):
    """Coefficients at `points`: the midpoints of `n` intervals, then both sides of each segment's ends.

    Dimensionless: lengths in path lengths, times in `time_unit`, torques in their limits, forces in `force_unit`.
    """

    # Grid
    width: Float[Array, "intervals"]  # ds of each interval
    side_node: Int[Array, "sides"]  # node of each side point
    side_sign: Float[Array, "sides"]  # 1: departs from rest here (a >= 0); -1: comes to rest (a <= 0); 0: neither
    is_live: Bool[Array, "points"]  # False: a side of a segment that the path does not have
    s: Float[Array, "points"]  # path parameter, in the path's own unit
    node_s: Float[Array, "nodes"]
    segment: Int[Array, "points"]
    # Constraints
    acceleration: Float[Array, "4 points"]  # coefficients of a in (1, b, tau1, tau2)
    force: Float[Array, "facets 4 points"]  # those of each facet of the friction cones
    viscous: Float[Array, "2 points"]  # c: joint i needs the torque tau_i + c_i v
    cap: Float[Array, "nodes"]  # largest b
    end_b: Float[Array, "nodes"]  # b at the ends, where fixed
    is_fixed: Bool[Array, "nodes"]
    duration: Float[Array, ""]  # time allowed; infinite: any
    # Units
    time_unit: Float[Array, ""]
    force_unit: Float[Array, ""]
    speed_unit: Float[Array, "points"]  # [1/s] of v at each point: segments have charts of their own

    @property
    def intervals(self) -> int:
        """How many intervals the path is divided into."""
        return self.width.shape[-1]


class SpeedRange(eqx.Module):
    """Speeds allowed at a path's ends and on the way.

    Args:
        start: `ds/dt` at the start [1/s]; NaN for any.
        end: `ds/dt` at the end [1/s]; NaN for any.
        joint: Largest joint speeds [rad/s].
    """

    start: Float[Array, ""]
    end: Float[Array, ""]
    joint: Float[Array, "2"]


def rest_to_rest() -> SpeedRange:
    """From rest to rest, without limits in between."""
    return SpeedRange(jnp.zeros(()), jnp.zeros(()), jnp.full(2, jnp.inf))


def discretise(
    dynamics: PathDynamics,
    duration: Float[Array, ""],
    speeds: SpeedRange,
    intervals: int = 200,
    rolling: int = MAX_ROLLING,
) -> PathProgramme:
    """Build the programme of one path.

    Args:
        dynamics: Tabulated path dynamics.
        duration: Longest time [s] allowed; infinite for any.
        speeds: Speeds allowed at the ends and on the way.
        intervals: Number of intervals, shared among the path's segments by length.
        rolling: Largest number of rolling contacts that the formation may have.
    """
    grid = _grid(dynamics, intervals)
    acceleration, force, velocity = jax.vmap(partial(_coefficients, dynamics))(grid.segment, grid.s)
    viscous = _viscous_torque(acceleration, force)
    facets = jax.vmap(partial(cone_facets, dynamics, rolling=rolling))(force)

    # Units: of length the path's, of time that of the largest acceleration, of force the largest without torque, or
    # a share of that with torques at their limits where there is hardly any without.
    limit, scale = dynamics.torque_limit, grid.scale
    length = stop_gradient(grid.width.sum())
    push = (jnp.abs(acceleration[:, 0]) + jnp.abs(acceleration[:, 3:]) @ limit) / scale
    time_unit = stop_gradient(jnp.sqrt(length / jnp.where(grid.is_live, push, 0.0).max()))
    pressed = jnp.maximum(jnp.abs(facets[:, :, 0]), LEAST_UNIT * jnp.abs(facets[:, :, 3:]) @ limit)
    force_unit = stop_gradient(jnp.where(grid.is_live, pressed.max(1), 0.0).max())
    speed_unit = scale * length / time_unit
    one = jnp.ones_like(scale)
    of_terms = jnp.stack([one, speed_unit**2, limit[0] * one, limit[1] * one])
    terms = jnp.array([0, 1, 3, 4])

    # Speeds at the ends and on the way.
    ends = jnp.array([0, intervals])
    given = jnp.stack([speeds.start, speeds.end]) / speed_unit[ends - jnp.array([0, 1])]
    fixed = ~jnp.isnan(given)
    end_b = jnp.where(fixed, given, 1.0) ** 2
    at_rest = fixed & (end_b == 0)
    each, last = jnp.arange(dynamics.first.shape[0]), dynamics.count - 1
    departs = jnp.where((each == 0) & at_rest[0], 1.0, 0.0)
    arrives = jnp.where((each == last) & at_rest[1], -1.0, 0.0)
    joint_speed = jnp.abs(velocity[:intervals, 3:]) * speed_unit[:intervals, None]
    cap = jnp.maximum(joint_speed / speeds.joint, SPEED_CAP**-0.5).max(1) ** -2  # differentiable without limits, too
    return PathProgramme(
        width=grid.width / length,
        side_node=grid.side_node,
        side_sign=jnp.concatenate([departs, arrives]),
        is_live=grid.is_live,
        s=grid.s,
        node_s=grid.node_s,
        segment=grid.segment,
        acceleration=acceleration[:, terms].T * of_terms * time_unit**2 / (length * scale),
        force=jnp.moveaxis(facets[:, :, terms], 0, 2) * of_terms / force_unit,
        viscous=viscous.T * speed_unit / limit[:, None],
        cap=jnp.minimum(jnp.append(cap, cap[-1]), jnp.append(cap[0], cap)),
        end_b=jnp.zeros(intervals + 1).at[ends].set(end_b),
        is_fixed=jnp.zeros(intervals + 1, bool).at[ends].set(fixed),
        duration=duration / time_unit,
        time_unit=time_unit,
        force_unit=force_unit,
        speed_unit=speed_unit,
    )


class _Grid(NamedTuple):
    """Places of a programme; `scale` is `ds/dt` over the speed in the first segment's unit."""

    width: Float[Array, "intervals"]  # in the first segment's unit
    node_s: Float[Array, "nodes"]
    s: Float[Array, "points"]
    segment: Int[Array, "points"]
    scale: Float[Array, "points"]
    is_live: Bool[Array, "points"]
    side_node: Int[Array, "sides"]


def _grid(dynamics: PathDynamics, intervals: int) -> _Grid:
    """Divide each segment, with nodes that are dense at its ends.

    Intervals of the next segment cover one that is too short, those of the last one what follows it. Its sides stay:
    what must hold where a motion begins or ends holds there.
    """
    each = jnp.arange(dynamics.first.shape[0])
    live = each < dynamics.count
    low, high = dynamics.breakpoints[:-1], dynamics.breakpoints[1:]
    length = jnp.where(live, high - low, 0.0)
    divided = length > SHORT_SEGMENT * length.sum()
    first, count = _allocate(jnp.where(divided, length, 0.0), divided, intervals)
    covered = jax.lax.cummax(jnp.where(divided, high, low[0]))  # up to the end of each segment
    start = jnp.append(low[0], covered[:-1])
    stop = jnp.where(covered == covered[-1], dynamics.breakpoints[dynamics.count], high)
    interval = jnp.arange(intervals)
    owner = (interval[:, None] >= (first + count)[None, :]).sum(1)
    begin, end = (
        start[owner] + (stop - start)[owner] * _graded((interval + k - first[owner]) / count[owner]) for k in (0, 1)
    )
    ratio = jnp.cumprod(jnp.where(live, dynamics.speed_ratio, 1.0))
    segment = jnp.concatenate([owner, each, each])
    return _Grid(
        width=(end - begin) / ratio[owner],
        node_s=jnp.append(begin, end[-1]),
        s=jnp.concatenate([(begin + end) / 2, low, high]),
        segment=segment,
        scale=ratio[segment],
        is_live=jnp.concatenate([jnp.ones(intervals, bool), live, live]),
        side_node=jnp.concatenate([first, first + count]),
    )


def _allocate(length, divided, intervals: int):
    """First interval and number of intervals of each segment: in proportion to its length, all in all `intervals`."""
    least = jnp.where(divided, MIN_INTERVALS, 0)
    spare = intervals - least.sum()
    count = least + jnp.floor(spare * length / length.sum()).astype(int)
    count = count.at[jnp.argmax(length)].add(intervals - count.sum())
    return jnp.cumsum(count) - count, count


def _graded(x):
    """Place of a node in its segment, as a fraction, from its number as a fraction."""
    return (1 - GRADING) * x + GRADING * (1 - jnp.cos(jnp.pi * x)) / 2


def _coefficients(dynamics: PathDynamics, segment, s):
    """Coefficients of the acceleration (5) and of the forces (rows x 5), and `dz/ds`."""
    panel, xi = locate_panel(dynamics, segment, s)
    return tuple(evaluate(table, panel, xi) for table in (dynamics.acceleration, dynamics.force, dynamics.velocity))


def _viscous_torque(acceleration, force):
    """`c` with `X v = -X_tau c v` for all outputs `X`: viscous friction as torques of the joints (least squares)."""
    every = jnp.concatenate([acceleration[:, None], force], axis=1)
    size = jnp.maximum(jnp.abs(every[..., 3:]).max((0, 2), keepdims=True), 1e-300)
    every = every / stop_gradient(size)
    pull, drag = every[..., 3:], -every[..., 2]
    p00, p01, p11 = ((pull[..., i] * pull[..., j]).sum(1) for i, j in ((0, 0), (0, 1), (1, 1)))
    q0, q1 = ((pull[..., i] * drag).sum(1) for i in (0, 1))
    det = p00 * p11 - p01**2
    both = jnp.stack([p11 * q0 - p01 * q1, p00 * q1 - p01 * q0], axis=1) / jnp.where(det > 0, det, 1.0)[:, None]
    # The torque of a finger that is away has no effect: then the other one's is determined alone.
    sizes = jnp.stack([p00, p11], axis=1)
    alone = jnp.where(sizes > 0, jnp.stack([q0, q1], axis=1) / jnp.where(sizes > 0, sizes, 1.0), 0.0)
    return jnp.where((det > 0)[:, None], both, alone)
