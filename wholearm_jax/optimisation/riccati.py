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

from wholearm_jax.core import fused_matmul
from wholearm_jax.optimisation.linearisation import (
    LinearisedProblem,
    columns,
    gauss_newton_blocks,
    jacobian_transpose_product,
    of_states,
    sizes,
)

SPREAD = 1e-8  # price of the square of any change: what no room depends on stays where it is


class ParametricLQ(NamedTuple):
    """`p^T (H + diag(price)) p / 2 - pull.p - m lean.p + weight m^2 / 2 - rise m` in the variables `p` and the margin's
    level `m`; `H` is made of the `gauss_newton_blocks` of the intervals."""

    blocks: Float[Array, "phases intervals 7 7"]
    price: Float[Array, "p"]
    pull: Float[Array, "p"]
    lean: Float[Array, "p"]
    weight: Float[Array, ""]
    rise: Float[Array, ""]


class _StageLayout(NamedTuple):
    """The numbers of a stage: state and torques at its knot, the shared numbers (`level`, `durations`, `goals` and
    `one`), torques at the next knot from `size` on.

    `interval_inputs` says which of an interval's seven numbers each is (7: none), `own` which variable of `p` counts
    in this
    stage and no other (the last: none). `ends` marks the goals of places and speeds in the stages that meet them, `v`
    are the last speeds of phases that hand over, `lost` and `steps` their equations.
    """

    level: int
    durations: slice
    one: int
    size: int
    local: Int[np.ndarray, "phases numbers"]
    own: Int[np.ndarray, "phases intervals numbers"]
    ends: Float[np.ndarray, "phases intervals 2 goals"]
    v: Int[np.ndarray, "seams"]
    lost: Int[np.ndarray, "seams"]
    steps: slice


@functools.cache
def _stage_layout(phases: int, knots: int) -> _StageLayout:
    """The same for all problems of a size."""
    intervals, each = knots - 1, np.arange(phases)
    level, durations, one = 4, slice(5, 5 + phases), 6 + 2 * phases
    size = one + 1
    after = np.arange(size, size + 2)
    local = np.full((phases, size + 2), 7)
    local[:, :4], local[:, after], local[each, 5 + each] = np.arange(4), [4, 5], 6
    knot = np.arange(2 * phases * knots).reshape(phases, knots, 2)
    count = 2 * knot.size + phases
    own = np.full((phases, intervals, size + 2), count)
    own[:, :, :2], own[:, :, 2:4] = knot.size + knot[:, :-1], knot[:, :-1]
    own[:, -1, after], own[each, -1, 5 + each] = knot[:, -1], 2 * knot.size + each
    ends = np.zeros((phases, intervals, 2, phases + 1))
    ends[each, -1, 0, each] = ends[-1, -1, 1, -1] = 1.0
    joins = phases * intervals * 2
    v, lost = knot.size + knot[:-1, -1, 1], joins + np.arange(phases - 1)
    return _StageLayout(level, durations, one, size, local, own, ends, v, lost, slice(joins + phases - 1, None))


class _LQStages(NamedTuple):
    """Second derivatives of what each stage costs, and how it leads to the state and the torques at the next knot;
    `ends` are the rows of a state before it is handed over, or must be what it is planned to be."""

    cost: Float[Array, "phases intervals numbers numbers"]
    onward: Float[Array, "phases intervals 4 numbers"]
    ends: Float[Array, "phases intervals 2 numbers"]


def kkt_step(
    linear: LinearisedProblem, stiff, aim, damping
) -> tuple[Float[Array, "p"], Float[Array, ""], Float[Array, "e"]]:
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
    pulls = jacobian_transpose_product(linear, aim), jacobian_transpose_product(linear, lean)
    return solve_lq(linear, ParametricLQ(gauss_newton_blocks(linear, stiff), price, *pulls, lean.sum(), rise))


def project_step(linear: LinearisedProblem, wanted: Float[Array, "p"]) -> Float[Array, "p"]:
    """The step that joins the intervals with changes of torques and durations nearest to those `wanted`. Where states
    are wanted, too, these pull: the gradient of a loss becomes that with respect to torques and durations alone."""
    price = jnp.ones(linear.still.shape).at[of_states(linear)].set(0.0)
    none, zero = jnp.zeros((*columns(linear).shape, 7)), jnp.zeros(())
    wanted = jnp.where(linear.still, 0.0, wanted)
    return solve_lq(linear, ParametricLQ(none, price, wanted, jnp.zeros_like(wanted), zero + 1, zero))[0]


def solve_lq(
    linear: LinearisedProblem, quadratic: ParametricLQ
) -> tuple[Float[Array, "p"], Float[Array, ""], Float[Array, "e"]]:
    """Where a quadratic function is least under `E p = -defect`: `p`, the level, and the prices of the equations."""
    at, stages = _stage_layout(*sizes(linear)), _stages(linear, quadratic)
    value, gain, rate = _backward_pass(at, stages, quadratic)
    # At the first knot the state is given, the torques are not.
    free = slice(2, at.one)
    torque, shared = jnp.split(jnp.linalg.solve(value[free, free], -value[free, at.one]), [2])
    shared = jnp.append(shared, 1.0)
    here, there = _forward_pass(at, stages, gain, torque, shared)
    chosen = -jnp.einsum("kij,kj->ki", gain, here)
    numbers = jnp.concatenate([here, chosen], axis=1).reshape(stages.cost.shape[:3])
    rates = jnp.einsum("kij,kj->ki", rate, there).reshape(*numbers.shape[:2], 4)
    last = jnp.einsum("pij,pj->pi", stages.ends[:, -1], numbers[:, -1])
    return _together(linear, numbers, last, shared), shared[0], _multipliers(linear, quadratic, rates, last, shared)


def _backward_pass(at: _StageLayout, stages: _LQStages, quadratic: ParametricLQ):
    """From the last knot to the first: second derivatives of `V` at the first; for each stage, how the torques at the
    next knot follow (`-gain`), and the first four rows of the second derivatives of `V` there."""
    size, level, one = at.size, at.level, at.one
    final = jnp.zeros((size, size)).at[level, level].set(quadratic.weight)
    final = final.at[level, one].set(-quadratic.rise).at[one, level].set(-quadratic.rise)
    kept = np.eye(size, size + 2)[level:]

    def back(value, stage):
        cost, onward = stage
        onward = jnp.concatenate([onward, kept])
        whole = (
            fused_matmul(onward.T, fused_matmul(value, onward)) + cost
        )  # sums of products: the loop is compiled whole
        (a, b), (_, c) = whole[size:, size:]
        first, second = whole[size:, :size]
        gain = jnp.stack([c * first - b * second, a * second - b * first]) / (a * c - b * b)
        return whole[:size, :size] - first[:, None] * gain[0] - second[:, None] * gain[1], (gain, value[:level])

    value, (gain, rate) = jax.lax.scan(back, final, (_in_turn(stages.cost), _in_turn(stages.onward)), reverse=True)
    return value, gain, rate


def _forward_pass(at: _StageLayout, stages: _LQStages, gain, torque, shared):
    """From the first knot to the last: all numbers of each stage but the torques at its next knot, and of the next."""
    onward = _in_turn(stages.onward)
    led = onward[:, :, : at.size] - onward[:, :, at.size :] @ gain
    steady = led[:, :, at.level :] @ shared
    begin = jnp.concatenate([jnp.zeros(2), torque])
    end, knots = jax.lax.scan(
        lambda x, stage: (fused_matmul(stage[0], x) + stage[1], x), begin, (led[:, :, : at.level], steady)
    )
    each = jnp.broadcast_to(shared, (knots.shape[0], shared.size))
    return [jnp.concatenate([x, each], axis=1) for x in (knots, jnp.concatenate([knots[1:], end[None]]))]


def _in_turn(stages):
    """Those of all phases, one after the other."""
    return stages.reshape(-1, *stages.shape[2:])


def _stages(linear: LinearisedProblem, quadratic: ParametricLQ) -> _LQStages:
    """The stages of a quadratic function; what stays has no part in them."""
    phases, knots = sizes(linear)
    at, stage = _stage_layout(phases, knots), (phases, knots - 1)
    moves = jnp.where(linear.still, 0.0, 1.0)[columns(linear)]
    ends = _placed(at, linear.rates.end * moves[..., None, :], -1)
    ends = ends.at[..., at.one].add(linear.defect[: 2 * phases * (knots - 1)].reshape(*stage, 2))
    torques = jnp.broadcast_to(np.eye(at.size + 2)[at.size :], (*stage, 2, at.size + 2))
    onward = jnp.concatenate([ends, torques], axis=2).at[:, -1, :2].set(0.0)
    bends = _placed(at, _placed(at, quadratic.blocks * moves[..., None] * moves[..., None, :], -1), -2)
    price = _own(at, quadratic.price)[..., None] * np.eye(at.size + 2)
    stages = _LQStages(bends + price + _mirrored(_beside(at, quadratic, ends)), onward, ends)
    return stages if phases == 1 else _handed_over(at, stages, linear, quadratic)


def _placed(at: _StageLayout, values, axis):
    """Numbers of an interval's seven along an axis, among those of its stage."""
    room = [(0, 0)] * values.ndim
    room[axis] = (0, 1)
    return jnp.stack([jnp.take(v, own, axis=axis) for v, own in zip(jnp.pad(values, room), at.local, strict=True)])


def _own(at: _StageLayout, values):
    """Numbers of variables, each in one stage."""
    return jnp.append(values, 0.0)[at.own]


def _mirrored(half):
    return half + jnp.swapaxes(half, -1, -2)


def _beside(at: _StageLayout, quadratic: ParametricLQ, ends):
    """What is linear, beside 1; what leans on the level, beside it; and what must end as planned, beside its price."""
    must = (ends[..., None] * at.ends[:, :, :, None]).sum(2)

    def none(count):
        return jnp.zeros((*must.shape[:3], count))

    lean, pull = -_own(at, quadratic.lean), -_own(at, quadratic.pull)
    phases = none(must.shape[0])
    return jnp.concatenate([none(at.level), lean[..., None], phases, must, pull[..., None], none(2)], axis=-1)


def _handed_over(at: _StageLayout, stages: _LQStages, linear: LinearisedProblem, quadratic: ParametricLQ) -> _LQStages:
    """The last stages of phases lead to the first knots of the next: there speeds follow and torques go on."""
    last, across = stages.ends[:-1, -1, 1], linear.across[at.lost]
    speed = -linear.across[at.lost, at.v][:, None] * last
    speed = speed.at[:, at.durations].add(-jnp.where(linear.still, 0.0, across)[:, -len(stages.ends) :])
    speed = speed.at[:, at.one].add(-linear.defect[at.lost])
    onward = stages.onward.at[:-1, -1, 1].set(speed)
    onward = onward.at[:-1, -1, 2:, at.one].add(-linear.defect[at.steps].reshape(-1, 2))
    # The speed that is handed over is no number of a stage: what it costs counts where it comes about.
    price, pull, lean = (a[at.v][:, None] * last for a in (quadratic.price, quadratic.pull, quadratic.lean))
    half = price[..., None] / 2 * last[:, None]
    half = half.at[..., at.one].add(-pull).at[..., at.level].add(-lean)
    return stages._replace(cost=stages.cost.at[:-1, -1].add(_mirrored(half)), onward=onward)


def _together(linear: LinearisedProblem, numbers, last, shared) -> Float[Array, "p"]:
    """The changes of all variables; what stays does."""
    at = _stage_layout(*sizes(linear))
    torque = jnp.concatenate([numbers[:, :, 2:4], numbers[:, -1:, at.size :]], axis=1)
    state = jnp.concatenate([numbers[:, :, :2], last[:, None]], axis=1)
    phases = numbers.shape[0]
    way = jnp.concatenate([torque.ravel(), state.ravel(), shared[1 : 1 + phases]])
    return jnp.where(linear.still, 0.0, way)


def _multipliers(linear: LinearisedProblem, quadratic: ParametricLQ, rates, last, shared) -> Float[Array, "e"]:
    """The price of each equation is how what all behind it costs grows with what it gives: `rates` at the next knot."""
    phases = rates.shape[0]
    at, goals = _stage_layout(*sizes(linear)), shared[1 + phases : -1]
    joins = rates[:, :, :2].at[:, -1, 0].set(goals[:-1]).at[-1, -1, 1].set(goals[-1])
    lost, steps = -rates[:-1, -1, 1], -rates[:-1, -1, 2:]
    costs = quadratic.price[at.v] * last[:-1, 1] - quadratic.pull[at.v] - quadratic.lean[at.v] * shared[0]
    handed = costs + linear.across[at.lost, at.v] * lost
    joins = joins.at[:-1, -1, 1].set(handed)
    return jnp.concatenate([joins.ravel(), lost, steps.ravel()])
