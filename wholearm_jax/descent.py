r"""Descend: the torques of one phase, improved by gradient descent through the simulation of its intervals.

The variables `p` are those of `shooting`. With forces `c_i`, in units of the bound, and all other rooms `r_j` (within
the limits on torques, their rates, speeds and the duration), the loss at temperature `T` is minus the smooth margin

    max_m [ m + T sum_i w_i log(c_i - m) ] + T sum_j w_j log r_j

subject to the intervals joining and the last ending at rest at the wire's end, `e(p) = 0`. Its maximum lies less than
`T` times the sum of weights below the largest margin. The direction comes from Newton's method on the conditions of
that maximum, the products `slack * price = T w` being unknowns of their own (a primal-dual interior point); the
curvature of the simulation itself is left out (Gauss-Newton). It is an optax gradient transformation, and any other
optax optimiser may take its place (`projected`).

A step follows the curve on which accelerations and squeezes at the knots change evenly (`moved`): on it the intervals
are nearly linear. Source of the interior point: J. Nocedal and S. J. Wright, Numerical Optimization, 2006, chapter 19.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.forces import smooth_margin, spare
from wholearm_jax.motion import Integration
from wholearm_jax.reduction import Table
from wholearm_jax.shooting import PARTS, ROWS, SAMPLES, STEPS, Variables, local, shoot
from wholearm_jax.squeeze import coefficients

HOTTEST, COLDEST = 0.1, 1e-4  # temperatures, as shares of the bound
NEAR = 0.95  # share of the way to a limit that a step may go
LEAST = 0.05  # slack that a room starts with at least
LONGEST = (0.1, 0.5)  # most that `s` and `v` at a knot may change in a step [lengths, lengths a duration]
SHORTER = 0.25  # a step that leaves what can be simulated is taken again with this share of it
JOINED = 1e-9  # sum of the defects below which the intervals count as joined


class Limits(eqx.Module):
    """What the result must respect: torque rates [N m/s], durations [s], which knots' torques stay as they are; and
    the `unit` of forces [N]."""

    rate: Float[Array, "2"]
    shortest: Float[Array, ""]
    longest: Float[Array, ""]
    pinned: Bool[Array, "knots"]
    unit: Float[Array, ""]


class Rooms(NamedTuple):
    """Of each interval: what must stay positive (forces over the margin, the others over zero), with weights (0: does
    not exist), and the state in which the interval ends."""

    room: Float[Array, "*intervals rooms"]
    weight: Float[Array, "*intervals rooms"]
    end: Float[Array, "*intervals 2"]


class Linear(NamedTuple):
    """All intervals at `p` with derivatives: `at` and `rates` (last axis: an interval's seven numbers), the defects `e`
    and `E = de/dp`; `bears` marks the rooms that the margin lowers, `still` the variables that stay."""

    at: Rooms
    rates: Rooms
    defect: Float[Array, "intervals 2"]
    across: Float[Array, "e p"]
    bears: Float[Array, "rooms"]
    still: Bool[Array, "p"]


def rooms(q: Float[Array, "7"], later: Float[Array, ""], table: Table, limits: Limits, how, intervals: int) -> Rooms:
    """One interval; `later` is 0 for the first, which starts at rest, and 1 for the others."""
    shot = shoot(table, how, intervals, q)
    torque, log = q[2:6], q[6]
    bounded = jnp.isfinite(limits.rate)
    step = jnp.where(bounded, limits.rate, 1.0) / table.torque_limit * jnp.exp(log) / intervals
    climb = jnp.where(bounded, (torque[2:] - torque[:2]) / step, 0.0)
    span = jnp.log(limits.longest / limits.shortest)
    free = span > 0
    ends = jnp.stack([log - jnp.log(limits.shortest), jnp.log(limits.longest) - log]) / jnp.where(free, span, 1.0)
    room = [(shot.forces / limits.unit).ravel(), 1 - torque, 1 + torque, 1 - climb, 1 + climb, shot.pace, ends]
    one = jnp.full((), 1 / intervals)
    sampled = (shot.weight[:, None] * ~spare(table)).ravel()
    climbs = jnp.tile(jnp.where(bounded, one / 4, 0.0), 2)
    paces = jnp.full(STEPS, one).at[0].multiply(later)
    weight = [sampled, jnp.full(8, one / 4), climbs, paces, jnp.full(2, jnp.where(free, one / 4, 0.0))]
    return Rooms(jnp.concatenate(room), jnp.concatenate(weight), shot.end)


def linearise(p: Variables, table: Table, limits: Limits, how: Integration) -> Linear:
    """Simulate all intervals, with first derivatives by forward mode."""
    knots = p.torque.shape[0]

    def both(q, later):
        at = rooms(q, later, table, limits, how, knots - 1)
        return at, at

    rates, at = jax.vmap(jax.jacfwd(both, has_aux=True))(local(p), (np.arange(knots - 1) > 0) * 1.0)
    columns, ends = _columns(knots)
    each = np.arange(2 * (knots - 1))
    across = jnp.zeros((2 * (knots - 1), 4 * knots + 1))
    across = across.at[each[:, None], np.repeat(columns, 2, axis=0)].add(rates.end.reshape(-1, columns.shape[1]))
    across = across.at[each, ends.ravel()].add(-1.0)
    still = _still(limits, knots)
    bears = np.arange(at.room.shape[1]) < PARTS * STEPS * SAMPLES * ROWS
    return Linear(at, rates, at.end - p.state[1:], jnp.where(still, 0.0, across), jnp.asarray(bears * 1.0), still)


def _columns(knots: int) -> tuple[Int[np.ndarray, "intervals 7"], Int[np.ndarray, "intervals 2"]]:
    """Where in the flattened `Variables` each interval's seven numbers and its end state stand."""
    torque, state = np.arange(2 * knots).reshape(knots, 2), np.arange(2 * knots, 4 * knots).reshape(knots, 2)
    duration = np.full((knots - 1, 1), 4 * knots)
    return np.concatenate([state[:-1], torque[:-1], torque[1:], duration], axis=1), state[1:]


def _still(limits: Limits, knots: int) -> Bool[Array, "p"]:
    """Pinned torques, the first and last state, and a fixed duration."""
    ends = np.zeros((knots, 2), bool)
    ends[[0, -1]] = True
    fixed = limits.longest <= limits.shortest
    return jnp.concatenate([jnp.repeat(limits.pinned, 2), jnp.asarray(ends.ravel()), fixed[None]])


def _gather(linear: Linear, values: Float[Array, "intervals rooms"]) -> Float[Array, "p"]:
    """`J^T values`, with `J` the derivatives of all rooms."""
    knots = linear.at.room.shape[0] + 1
    columns, _ = _columns(knots)
    pull = jnp.zeros(4 * knots + 1).at[columns].add(jnp.einsum("kr,krq->kq", values, linear.rates.room))
    return jnp.where(linear.still, 0.0, pull)


def _metric(linear: Linear, values: Float[Array, "intervals rooms"]) -> Float[Array, "p p"]:
    """`J^T diag(values) J`, the identity for variables that stay."""
    knots, still = linear.at.room.shape[0] + 1, linear.still
    columns, _ = _columns(knots)
    n = 4 * knots + 1
    blocks = jnp.einsum("kr,krq,krp->kqp", values, linear.rates.room, linear.rates.room)
    metric = jnp.zeros((n, n)).at[columns[:, :, None], columns[:, None, :]].add(blocks)
    return jnp.where(still[:, None] | still, 0.0, metric) + jnp.diag(jnp.where(still, 1.0, 1e-8))


class Duals(NamedTuple):
    """The interior point's own unknowns: slack and price of every room, the level `m` of the margin (NaN: not yet
    chosen), the temperature, and the shares of its last step that were taken."""

    slack: Float[Array, "intervals rooms"]
    price: Float[Array, "intervals rooms"]
    level: Float[Array, ""]
    temperature: Float[Array, ""]
    steps: Float[Array, "2"]


def interior_point() -> optax.GradientTransformationExtraArgs:
    """The primal-dual direction as an optax transformation; wants `linear=`, and makes its own gradient from it."""

    def init(params):
        intervals = (params.shape[0] - 1) // 4 - 1
        shape = (intervals, PARTS * STEPS * SAMPLES * ROWS + 8 + 4 + STEPS + 2)
        start = jnp.full((), HOTTEST)
        return Duals(jnp.ones(shape), jnp.zeros(shape), jnp.full((), jnp.nan), start, jnp.zeros(2))

    def update(updates, state: Duals, params=None, *, linear: Linear, **_):
        at, bears, hot = linear.at, linear.bears, state.temperature
        live = at.weight > 0
        least = jnp.where(live & (bears > 0), at.room, jnp.inf).min()
        level = jnp.where(jnp.isnan(state.level), least - 2 * LEAST, state.level)
        given = jnp.where(live, at.room - bears * level, 1.0)
        fresh = ~(state.price > 0)
        slack = jnp.where(live, jnp.maximum(given, jnp.where(fresh, LEAST, state.slack)), 1.0)
        target = hot * at.weight / slack
        price = jnp.where(live, jnp.where(fresh, target, state.price), 0.0)
        stiff = price / slack
        miss = given - slack
        aim = jnp.where(live, target - stiff * miss, 0.0)
        way, rise = _solve(linear, stiff, aim)
        columns, _ = _columns(at.room.shape[0] + 1)
        dslack = jnp.einsum("krq,kq->kr", linear.rates.room, way[columns]) - bears * rise + miss
        dslack = jnp.where(live, dslack, 0.0)
        dprice = jnp.where(live, target - price - stiff * dslack, 0.0)
        primal = jnp.minimum(_reach(slack, dslack), _cap(way))
        dual = _reach(price, dprice)
        both = jnp.minimum(primal, dual)
        cooling = jnp.where(both > 0.5, 0.2, jnp.where(both > 0.2, 0.6, 1.0))
        state = Duals(
            slack + primal * dslack,
            price + dual * dprice,
            level + primal * rise,
            jnp.maximum(hot * cooling, COLDEST),
            jnp.stack([primal, dual]),
        )
        return primal * way, state

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _solve(linear: Linear, stiff, aim):
    """The step of `p` and of the margin's level: one symmetric system with the joining of the intervals."""
    bears, across = linear.bears, linear.across
    n, e = across.shape[1], across.shape[0]
    lean = _gather(linear, stiff * bears)
    matrix = jnp.zeros((n + 1 + e, n + 1 + e))
    matrix = matrix.at[:n, :n].set(_metric(linear, stiff)).at[n, n].set((stiff * bears).sum())
    matrix = matrix.at[:n, n].set(-lean).at[n, :n].set(-lean)
    matrix = matrix.at[:n, n + 1 :].set(across.T).at[n + 1 :, :n].set(across)
    right = [_gather(linear, aim), (1 - (bears * aim).sum())[None], -linear.defect.ravel()]
    step = jnp.linalg.solve(matrix, jnp.concatenate(right))
    return step[:n], step[n]


def _reach(value, change):
    """The share of a change that keeps every value positive."""
    falls = change < 0
    return jnp.minimum(1.0, NEAR * jnp.where(falls, -value / jnp.where(falls, change, 1.0), jnp.inf).min())


def _cap(way):
    """The share of a step that keeps the states' changes within `LONGEST`."""
    knots = (way.shape[0] - 1) // 4
    change = jnp.abs(way[2 * knots : 4 * knots].reshape(knots, 2)).max(0)
    return (jnp.array(LONGEST) / jnp.maximum(change, 1e-30)).min()


def _split(knots: int) -> tuple[Int[np.ndarray, "free"], Int[np.ndarray, "states"]]:
    """Places in the flattened variables of torques and duration, and of all states but the first."""
    return np.append(np.arange(2 * knots), 4 * knots), np.arange(2 * knots + 2, 4 * knots)


def _follow(linear: Linear, free, states):
    """How the states follow the torques and the duration where the intervals join: `follow @ change + apart`."""
    across = linear.across.at[[-2, -1], states[-2:]].set(-1.0)
    solved = jnp.linalg.solve(across[:, states], jnp.column_stack([across[:, free], linear.defect.ravel()]))
    return -solved[:, :-1], -solved[:, -1]


class Cooling(NamedTuple):
    """State of `projected`: the inner optimiser's, the level `m` of the smooth margin, and the temperature."""

    inner: optax.OptState
    level: Float[Array, ""]
    temperature: Float[Array, ""]
    steps: Float[Array, "2"]


def projected(optimiser: optax.GradientTransformation, cooling: float = 0.98) -> optax.GradientTransformationExtraArgs:
    """Any optax optimiser on torques and duration: the states follow so that the intervals join, and its updates are
    projected onto those that arrive. The temperature falls by `cooling` a step."""
    optimiser = optax.with_extra_args_support(optimiser)

    def init(params):
        return Cooling(optimiser.init(params), jnp.full((), jnp.nan), jnp.full((), HOTTEST), jnp.zeros(2))

    def update(updates, state: Cooling, params=None, *, linear: Linear, **extra):
        at, hot = linear.at, state.temperature
        _, level = smooth_margin(at.room, at.weight * linear.bears, hot)
        above = at.room - linear.bears * level
        # Outside a limit the loss is infinite: there the pull back to it is that of a small room.
        pull = _gather(linear, hot * at.weight / jnp.maximum(above, hot))
        free, states = _split(at.room.shape[0] + 1)
        follow, apart = _follow(linear, free, states)
        last = follow[-2:]

        def arriving(step, rest):
            return step - last.T @ jnp.linalg.solve(last @ last.T, last @ step + rest)

        gradient = arriving(-pull[free] - follow[:-2].T @ pull[states[:-2]], 0.0)
        updates, inner = optimiser.update(jnp.zeros_like(pull).at[free].set(gradient), state.inner, params, **extra)
        step = arriving(jnp.where(linear.still, 0.0, jnp.asarray(updates))[free], apart[-2:])
        way = jnp.zeros_like(pull).at[free].set(step).at[states[:-2]].set((follow @ step + apart)[:-2])
        columns, _ = _columns(at.room.shape[0] + 1)
        change = jnp.einsum("krq,kq->kr", linear.rates.room, way[columns])
        within = (at.weight > 0) & (linear.bears == 0) & (at.room > 0)
        share = jnp.minimum(_reach(jnp.where(within, at.room, 1.0), jnp.where(within, change, 0.0)), _cap(way))
        cooled = jnp.maximum(cooling * hot, COLDEST)
        return share * way, Cooling(inner, level, cooled, jnp.stack([share, share]))

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def moved(p: Variables, way: Variables, share, table: Table, limits: Limits) -> Variables:
    """`p` after a `share` of a direction, on the curve along which accelerations and squeezes at knots change evenly.

    Torques balance to a small remainder, the acceleration: where the state at a knot moves, they have to move with it.
    The curve's tangent is the direction. A knot that passes from one piece of the wire to another goes straight.
    """
    limit, length = table.torque_limit, table.length

    def balance(state, log):
        """Acceleration in lengths a duration squared is `rest + pull . torque`, the squeeze `free . torque`."""
        motion, _ = coefficients(table, table.breaks[0] + length * state[0])
        time = jnp.exp(log)
        v = state[1] * length / time
        rest = motion[0] + motion[1] * v**2 + motion[2] * v
        pull = motion[3:] * limit
        free = jnp.stack([-pull[1], pull[0]]) / jnp.sqrt(jnp.maximum(pull @ pull, 1e-300))
        return time**2 / length * rest, time**2 / length * pull, free

    def knot(state, torque, dstate, dtorque, pinned):
        def motion(state, torque, log):
            rest, pull, free = balance(state, log)
            return rest + pull @ torque, free @ torque

        tangents = (dstate, dtorque, way.log_duration)
        (a, squeeze), (da, dsqueeze) = jax.jvp(motion, (state, torque, p.log_duration), tangents)
        there, straight = state + share * dstate, torque + share * dtorque
        rest, pull, free = balance(there, p.log_duration + share * way.log_duration)
        size = pull @ pull
        curved = pull * (a + share * da - rest) / jnp.where(size > 0, size, 1.0) + free * (squeeze + share * dsqueeze)
        piece = [(table.breaks[0] + length * s[0] >= table.breaks[1:-1]).sum() for s in (state, there)]
        return jnp.where((piece[0] == piece[1]) & (size > 0) & ~pinned, curved, straight)

    return Variables(
        jax.vmap(knot)(p.state, p.torque, way.state, way.torque, limits.pinned),
        p.state + share * way.state,
        p.log_duration + share * way.log_duration,
    )


class Descent(NamedTuple):
    """A descent on its way: variables, the optimiser's state, and the step that led here, to take again if it failed.

    `least` is the smallest sampled force over the bound and `apart` the sum of the defects, both of the variables
    before the step (NaN where they cannot be simulated).
    """

    p: Variables
    state: Any  # the optimiser's, with `temperature` and `steps`
    before: Variables
    way: Variables
    share: Float[Array, ""]
    least: Float[Array, ""]
    apart: Float[Array, ""]


@eqx.filter_jit
def begin(p: Variables, optimiser) -> Descent:
    """A descent before its first step."""
    zero = jnp.zeros(())
    return Descent(p, optimiser.init(ravel_pytree(p)[0]), p, jax.tree.map(jnp.zeros_like, p), zero + 1, zero, zero)


@eqx.filter_jit
def advance(d: Descent, table: Table, limits: Limits, how: Integration, optimiser) -> Descent:
    """Simulate, and take a step; where `d.p` cannot be simulated, go back and take a shorter one."""
    linear = linearise(d.p, table, limits, how)
    at = linear.at
    sound = jnp.all(jnp.isfinite(at.room)) & jnp.all(jnp.isfinite(linear.defect))
    least = jnp.where((at.weight > 0) & (linear.bears > 0), at.room, jnp.inf).min()
    apart = jnp.abs(linear.defect).sum()

    def onward():
        flat, unravel = ravel_pytree(d.p)
        way, state = optimiser.update(jnp.zeros_like(flat), d.state, flat, linear=linear)
        way = unravel(way)
        return Descent(moved(d.p, way, 1.0, table, limits), state, d.p, way, jnp.ones(()), least, apart)

    def again():
        share = d.share * SHORTER
        nan = jnp.full((), jnp.nan)
        return d._replace(p=moved(d.before, d.way, share, table, limits), share=share, least=nan, apart=nan)

    return jax.lax.cond(sound, onward, again)
