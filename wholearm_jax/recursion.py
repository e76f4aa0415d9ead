r"""Recursion: the least of a quadratic function of all variables under which intervals join, knot after knot.

From one knot to the next a state `x` and the torques `tau` lead on to `tau+`, freely chosen, and to `x+`, as far as the
intervals are linear. All stages share the numbers `b`: the margin's level, the durations, the prices of the places and
speeds that phases must end with, and 1, which what is linear stands beside. What all that follows costs is quadratic,

    V(x, tau, b),    V = min over tau+ of [ stage(x, tau, b, tau+) + V+(x+, tau+, b) ]

so that each knot is left by one product and one 2x2 inverse, the last first; `b` and the first torques follow from the
system that is left. That takes a time proportional to the number of knots.

Source: C. V. Rao, S. J. Wright and J. B. Rawlings, Application of interior-point methods to model predictive control,
Journal of Optimization Theory and Applications 99, 1998. Derivation: section 9 of `docs/derivation.md`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.linearisation import Linear, blocks, columns, gather, of_states, sizes

SPREAD = 1e-8  # price of the square of any change: what no room depends on stays where it is


class Quadratic(NamedTuple):
    """`p^T (H + diag(price)) p / 2 - pull.p - m lean.p + weight m^2 / 2 - rise m` in the variables `p` and the margin's
    level `m`; `H` is made of the `blocks` of the intervals."""

    blocks: Float[Array, "phases intervals 7 7"]
    price: Float[Array, "p"]
    pull: Float[Array, "p"]
    lean: Float[Array, "p"]
    weight: Float[Array, ""]
    rise: Float[Array, ""]


class _Order(NamedTuple):
    """The numbers of a stage: state and torques at its knot, the shared numbers (the level, then `durations`, `goals`
    and `one`), torques at the next knot from `size` on.

    `local` says which of an interval's seven numbers each is (7: none), `own` which variable of `p` counts in this
    stage and no other (the last: none). `ends` marks the goals of places and speeds in the stages that meet them, `v`
    are the last speeds of phases that hand over, `lost` and `steps` their equations.
    """

    size: int
    durations: slice
    goals: slice
    one: int
    local: Int[np.ndarray, "phases 1 numbers"]
    own: Int[np.ndarray, "phases intervals numbers"]
    ends: Float[np.ndarray, "2 phases intervals goals"]
    v: Int[np.ndarray, "seams"]
    lost: Int[np.ndarray, "seams"]
    steps: slice


@functools.cache
def _order(phases: int, knots: int) -> _Order:
    """The same for all problems of a size."""
    intervals, each = knots - 1, np.arange(phases)
    durations, goals = slice(5, 5 + phases), slice(5 + phases, 6 + 2 * phases)
    one, size = goals.stop, goals.stop + 1
    after = np.arange(size, size + 2)
    local = np.full((phases, 1, size + 2), 7)
    local[:, :, :4], local[:, :, after], local[each, 0, 5 + each] = np.arange(4), [4, 5], 6
    knot = np.arange(2 * phases * knots).reshape(phases, knots, 2)
    count = 2 * knot.size + phases
    own = np.full((phases, intervals, size + 2), count)
    own[:, :, :2], own[:, :, 2:4] = knot.size + knot[:, :-1], knot[:, :-1]
    own[:, -1, after], own[each, -1, 5 + each] = knot[:, -1], 2 * knot.size + each
    ends = np.zeros((2, phases, intervals, phases + 1))
    ends[0, each, -1, each] = ends[1, -1, -1, -1] = 1.0
    joins = phases * intervals * 2
    v, lost = knot.size + knot[:-1, -1, 1], joins + np.arange(phases - 1)
    return _Order(size, durations, goals, one, local, own, ends, v, lost, slice(joins + phases - 1, None))


class _Stages(NamedTuple):
    """What each stage costs, half of its second derivatives and half of what mirrors them, and how it leads to the
    state and the torques of the next; `ends` are the rows of the state before it is handed over."""

    cost: Float[Array, "phases intervals numbers numbers"]
    onward: Float[Array, "phases intervals 4 numbers"]
    ends: Float[Array, "phases intervals 2 numbers"]


def newton_step(linear: Linear, stiff, aim, damping) -> tuple[Float[Array, "p"], Float[Array, ""], Float[Array, "e"]]:
    """The steps of `p` and of the margin's level `m`, and the prices `y` of the equations that `p` must keep:

        (J^T S J + damping) p - J^T S b m + E^T y = J^T aim
        b^T S b m - b^T S J p = 1 - b^T aim,    E p = -defect

    with the derivatives `J` of all rooms and `E` of the equations, `S = diag(stiff)`, and 1 in `b` for rooms that the
    margin lowers. `damping` is a price of the step's size: it keeps steps small along ways that the loss hardly sees.
    """
    bears = linear.bears
    lean = stiff * bears
    price = jnp.full(linear.still.shape, SPREAD) + damping
    rise = 1 - (bears * aim).sum()
    return least(
        linear, Quadratic(blocks(linear, stiff), price, gather(linear, aim), gather(linear, lean), lean.sum(), rise)
    )


def nearest(linear: Linear, wanted: Float[Array, "p"]) -> Float[Array, "p"]:
    """The step that joins the intervals with changes of torques and durations nearest to those `wanted`. Where states
    are wanted, too, these pull: the gradient of a loss becomes that with respect to torques and durations alone."""
    price = jnp.ones(linear.still.shape).at[of_states(linear)].set(0.0)
    none, zero = jnp.zeros((*columns(linear).shape, 7)), jnp.zeros(())
    wanted = jnp.where(linear.still, 0.0, wanted)
    return least(linear, Quadratic(none, price, wanted, jnp.zeros_like(wanted), zero + 1, zero))[0]


def least(linear: Linear, quadratic: Quadratic) -> tuple[Float[Array, "p"], Float[Array, ""], Float[Array, "e"]]:
    """Where a quadratic function is least under `E p = -defect`: `p`, the level, and the prices of the equations."""
    at, stages = _order(*sizes(linear)), _stages(linear, quadratic)
    size, one = at.size, at.one
    final = jnp.zeros((size, size)).at[4, 4].set(quadratic.weight)
    final = final.at[4, one].set(-quadratic.rise).at[one, 4].set(-quadratic.rise)
    shared = np.eye(size, size + 2)[4:]

    def back(value, stage):
        cost, onward = stage
        onward = jnp.concatenate([onward, shared])
        whole = onward.T @ (value @ onward) + cost
        (a, b), (_, c) = whole[size:, size:]
        first, second = whole[size:, :size]
        det = a * c - b * b
        gain = jnp.stack([c * first - b * second, a * second - b * first]) / det
        return whole[:size, :size] - first[:, None] * gain[0] - second[:, None] * gain[1], (gain, value[:4])

    each = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (stages.cost, stages.onward))
    value, (gain, rate) = jax.lax.scan(back, final, each, reverse=True)
    # At the first knot the state is given, the torques are not.
    torque, rest = jnp.split(jnp.linalg.solve(value[2:one, 2:one], -value[2:one, one]), [2])
    rest = jnp.append(rest, 1.0)

    led = each[1][:, :, :size] - each[1][:, :, size:] @ gain
    steady = led[:, :, 4:] @ rest
    begin = jnp.concatenate([jnp.zeros(2), torque])
    end, knot = jax.lax.scan(lambda x, stage: (stage[0] @ x + stage[1], x), begin, (led[:, :, :4], steady))

    def of_stages(knot):
        return jnp.concatenate([knot, jnp.broadcast_to(rest, (knot.shape[0], rest.size))], axis=1)

    here, there = of_stages(knot), of_stages(jnp.concatenate([knot[1:], end[None]]))
    numbers = jnp.concatenate([here, -jnp.einsum("kij,kj->ki", gain, here)], axis=1)
    numbers = numbers.reshape(stages.cost.shape[:3])
    rate = jnp.einsum("kij,kj->ki", rate, there).reshape(*numbers.shape[:2], 4)
    last = jnp.einsum("pij,pj->pi", stages.ends[:, -1], numbers[:, -1])
    return _together(linear, numbers, last, rest), rest[0], _prices(linear, quadratic, rate, last, rest)


def _stages(linear: Linear, quadratic: Quadratic) -> _Stages:
    """The stages of a quadratic function; what stays has no part in them."""
    phases, knots = sizes(linear)
    at = _order(phases, knots)
    stage = phases, knots - 1
    moves = jnp.where(linear.still, 0.0, 1.0)[columns(linear)]

    def placed(values, axis):
        """Numbers of an interval's seven among those of its stage."""
        room = [(0, 0)] * values.ndim
        room[axis] = (0, 1)
        return jnp.stack(
            [jnp.take(v, row[0], axis=axis) for v, row in zip(jnp.pad(values, room), at.local, strict=True)]
        )

    def counted(values):
        """Numbers of variables, each in one stage."""
        return jnp.append(values, 0.0)[at.own]

    def column(values):
        return values[..., None]

    ends = placed(linear.rates.end * moves[..., None, :], -1)
    ends = ends.at[..., at.one].add(linear.defect[: 2 * phases * (knots - 1)].reshape(*stage, 2))
    goals = sum(column(ends[:, :, k]) * at.ends[k][:, :, None] for k in range(2))

    def none(count):
        return jnp.zeros((*stage, at.size + 2, count))

    half = [none(4), column(-counted(quadratic.lean)), none(phases), goals, column(-counted(quadratic.pull)), none(2)]
    half = jnp.concatenate(half, axis=-1)
    own = counted(quadratic.price)[..., None] * np.eye(at.size + 2)
    cost = placed(placed(quadratic.blocks * moves[..., None] * moves[..., None, :], -1), -2) + own
    cost = cost + half + jnp.swapaxes(half, -1, -2)

    torques = jnp.broadcast_to(np.eye(at.size + 2)[at.size :], (*stage, 2, at.size + 2))
    onward = jnp.concatenate([ends, torques], axis=2).at[:, -1, :2].set(0.0)
    if phases > 1:
        before, across = ends[:-1, -1, 1], linear.across[at.lost]
        speed = -column(across[np.arange(phases - 1), at.v]) * before
        speed = speed.at[:, at.durations].add(-jnp.where(linear.still, 0.0, across)[:, -phases:])
        speed = speed.at[:, at.one].add(-linear.defect[at.lost])
        onward = onward.at[:-1, -1, 1].set(speed)
        onward = onward.at[:-1, -1, 2:, at.one].add(-linear.defect[at.steps].reshape(-1, 2))
        # The speed that is handed over is no number of a stage: what it costs counts where it comes about.
        price, pull, lean = (column(a[at.v]) * before for a in (quadratic.price, quadratic.pull, quadratic.lean))
        costs = column(price / 2) * before[:, None]
        costs = costs.at[..., at.one].add(-pull).at[..., 4].add(-lean)
        cost = cost.at[:-1, -1].add(costs + jnp.swapaxes(costs, -1, -2))
    return _Stages(cost, onward, ends)


def _together(linear: Linear, numbers, last, rest) -> Float[Array, "p"]:
    """The changes of all variables; what stays does."""
    at = _order(*sizes(linear))
    torque = jnp.concatenate([numbers[:, :, 2:4], numbers[:, -1:, at.size :]], axis=1)
    state = jnp.concatenate([numbers[:, :, :2], last[:, None]], axis=1)
    phases = numbers.shape[0]
    way = jnp.concatenate([torque.ravel(), state.ravel(), rest[1 : 1 + phases]])
    return jnp.where(linear.still, 0.0, way)


def _prices(linear: Linear, quadratic: Quadratic, rate, last, rest) -> Float[Array, "e"]:
    """The price of each equation is what all behind it costs more with what it gives: `rate` at the next knot."""
    phases = rate.shape[0]
    at, goals = _order(*sizes(linear)), rest[1 + phases : -1]
    joins = rate[:, :, :2].at[:, -1, 0].set(goals[:-1]).at[-1, -1, 1].set(goals[-1])
    lost, steps = -rate[:-1, -1, 1], -rate[:-1, -1, 2:]
    costs = quadratic.price[at.v] * last[:-1, 1] - quadratic.pull[at.v] - quadratic.lean[at.v] * rest[0]
    handed = costs + linear.across[at.lost, at.v] * lost
    joins = joins.at[:-1, -1, 1].set(handed)
    return jnp.concatenate([joins.ravel(), lost, steps.ravel()])
