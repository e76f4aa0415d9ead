r"""The linear-quadratic problem of a Newton step, stage by stage.

A stage is an interval between two knots. Its state is `z = (x, tau, b)`: the changes of state `x = (s, v)` and torques
`tau` at its knot, and the numbers `b` that all stages share: the margin's level, the durations, the multipliers of the
places and speeds with which phases must end, and 1. Its control is `u`, the torques at the next knot. With the
homogeneous 1 in `z`, linear terms stand in the same matrices as quadratic ones,

    cost = 1/2 [z; u]^T [Q S; S^T R] [z; u],    (x+, tau+) = [A B] [z; u]

where `q`, `r` of the literature are the column of 1 in the Hessian, and `f` that in the dynamics.

Derivation: section 9 of `docs/derivation.md`.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.optimisation.linearisation import LinearisedProblem
from wholearm_jax.optimisation.variables import INPUTS, interval_input_indices, state_slice, variable_count

X, TAU, LEVEL = slice(0, 2), slice(2, 4), 4  # where state, torques and level stand in `z`


class ParametricLQ(NamedTuple):
    """A quadratic function of the variables `p` and the margin's level `m`:

    p^T (H + diag(d)) p / 2 + g.p + m c.p + h m^2 / 2 + k m
    """

    hessian_blocks: Float[Array, "phases intervals 7 7"]  # H by intervals, as of `gauss_newton_blocks`
    diagonal: Float[Array, "p"]  # d
    gradient: Float[Array, "p"]  # g
    level_coupling: Float[Array, "p"]  # c
    level_hessian: Float[Array, ""]  # h
    level_gradient: Float[Array, ""]  # k


class StageLayout(NamedTuple):
    """Where the numbers of a stage `[z; u]` stand, and which variables and equations they are."""

    # Within [z; u], after X, TAU and LEVEL
    durations: slice
    multipliers: slice  # of the states with which phases must end
    one: int
    size: int  # of z; u stands behind

    # Which variables the numbers are
    input_of_number: Int[np.ndarray, "phases numbers"]  # among an interval's inputs; 7: none
    variable_of_number: Int[np.ndarray, "phases intervals numbers"]  # those that this stage counts; the last: none

    # Ends of phases
    end_multiplier: Float[np.ndarray, "phases intervals 2 multipliers"]  # 1 where a multiplier belongs to an end state
    last_speed: Int[np.ndarray, "linkages"]  # variable: last speed of a phase that another follows at speed
    speed_linkage: Int[np.ndarray, "linkages"]  # equation that links it
    torque_linkage: slice  # equations that link the torques


class LQStages(NamedTuple):
    """Hessian and dynamics of each stage."""

    hessian: Float[Array, "phases intervals numbers numbers"]  # [Q S; S^T R]
    dynamics: Float[Array, "phases intervals 4 numbers"]  # [A B], onto state and torques of the next stage
    terminal: Float[Array, "phases intervals 2 numbers"]  # onto the interval's end state, before linkage


@functools.cache
def stage_layout(phases: int, knots: int) -> StageLayout:
    """Build the layout, the same for all problems of a size."""
    intervals, each = knots - 1, np.arange(phases)
    durations, multipliers = slice(5, 5 + phases), slice(5 + phases, 6 + 2 * phases)
    one = multipliers.stop
    size = one + 1
    control = np.arange(size, size + 2)
    duration = durations.start + each  # the number that is each phase's own duration

    input_of_number = np.full((phases, size + 2), INPUTS)
    input_of_number[:, :4], input_of_number[:, control], input_of_number[each, duration] = np.arange(4), [4, 5], 6

    # A stage counts the variables of its knot; a phase's last one those of the last torques and of the duration, too.
    count = variable_count(phases, knots)
    inputs = interval_input_indices(phases, knots)
    variable_of_number = np.full((phases, intervals, size + 2), count)
    variable_of_number[:, :, :4] = inputs[:, :, :4]
    variable_of_number[:, -1, control], variable_of_number[each, -1, duration] = inputs[:, -1, 4:6], inputs[:, -1, 6]

    # Phases must end at their paths' ends, the last one at rest.
    end_multiplier = np.zeros((phases, intervals, 2, phases + 1))
    end_multiplier[each, -1, 0, each] = end_multiplier[-1, -1, 1, -1] = 1.0
    last_speed = np.arange(count)[state_slice(phases, knots)].reshape(phases, knots, 2)[:-1, -1, 1]
    defects = phases * intervals * 2
    return StageLayout(
        durations=durations,
        multipliers=multipliers,
        one=one,
        size=size,
        input_of_number=input_of_number,
        variable_of_number=variable_of_number,
        end_multiplier=end_multiplier,
        last_speed=last_speed,
        speed_linkage=defects + np.arange(phases - 1),
        torque_linkage=slice(defects + phases - 1, None),
    )


def build_stages(linear: LinearisedProblem, quadratic: ParametricLQ) -> LQStages:
    """Distribute a quadratic function and the linearised equations over the stages; fixed variables have no part."""
    phases, knots = linear.phases, linear.knots
    at, shape = stage_layout(phases, knots), (phases, knots - 1)
    is_free = jnp.where(linear.is_fixed, 0.0, 1.0)[linear.input_indices]

    # Dynamics: the linearised interval onto the next state, the control onto the next torques.
    terminal = _inputs_to_numbers(at, linear.end_jacobian * is_free[..., None, :], -1)
    terminal = terminal.at[..., at.one].add(linear.defect[: 2 * phases * (knots - 1)].reshape(*shape, 2))
    control = jnp.broadcast_to(np.eye(at.size + 2)[at.size :], (*shape, 2, at.size + 2))
    dynamics = jnp.concatenate([terminal, control], axis=2).at[:, -1, X].set(0.0)

    # Cost: Hessians of the intervals, the diagonal, and what is linear.
    blocks = quadratic.hessian_blocks * is_free[..., None] * is_free[..., None, :]
    hessian = _inputs_to_numbers(at, _inputs_to_numbers(at, blocks, -1), -2)
    diagonal = _of_variables(at, quadratic.diagonal)[..., None] * np.eye(at.size + 2)
    hessian = hessian + diagonal + _symmetrised(_shared_columns(at, quadratic, terminal))
    stages = LQStages(hessian, dynamics, terminal)
    return stages if phases == 1 else _link_phases(at, stages, linear, quadratic)


def _inputs_to_numbers(at: StageLayout, values, axis):
    """Place numbers of an interval's inputs along an axis among those of its stage."""
    padding = [(0, 0)] * values.ndim
    padding[axis] = (0, 1)
    padded = jnp.pad(values, padding)
    return jnp.stack([jnp.take(v, rows, axis=axis) for v, rows in zip(padded, at.input_of_number, strict=True)])


def _of_variables(at: StageLayout, values: Float[Array, "p"]) -> Float[Array, "phases intervals numbers"]:
    """Place numbers of variables, each in one stage."""
    return jnp.append(values, 0.0)[at.variable_of_number]


def _symmetrised(half):
    return half + jnp.swapaxes(half, -1, -2)


def _shared_columns(at: StageLayout, quadratic: ParametricLQ, terminal):
    """Return the columns of the shared numbers: level, end multipliers and 1."""
    must_vanish = (terminal[..., None] * at.end_multiplier[:, :, :, None]).sum(2)

    def zeros(count):
        return jnp.zeros((*must_vanish.shape[:3], count))

    coupling, gradient = (_of_variables(at, a)[..., None] for a in (quadratic.level_coupling, quadratic.gradient))
    durations = zeros(must_vanish.shape[0])
    return jnp.concatenate([zeros(LEVEL), coupling, durations, must_vanish, gradient, zeros(2)], axis=-1)


def _link_phases(at: StageLayout, stages: LQStages, linear: LinearisedProblem, quadratic: ParametricLQ) -> LQStages:
    """Lead the last stage of each phase to the first knot of the next: speeds after impacts follow, torques go on."""
    # The next phase's first speed follows from this one's last, both durations and the error left.
    last, linkage = stages.terminal[:-1, -1, 1], linear.equality_jacobian[at.speed_linkage]
    speed = -linear.equality_jacobian[at.speed_linkage, at.last_speed][:, None] * last
    speed = speed.at[:, at.durations].add(-jnp.where(linear.is_fixed, 0.0, linkage)[:, -len(stages.terminal) :])
    speed = speed.at[:, at.one].add(-linear.defect[at.speed_linkage])
    dynamics = stages.dynamics.at[:-1, -1, 1].set(speed)
    dynamics = dynamics.at[:-1, -1, TAU, at.one].add(-linear.defect[at.torque_linkage].reshape(-1, 2))

    # The last speed is no number of a stage: its cost counts where it comes about.
    terms = quadratic.diagonal, quadratic.gradient, quadratic.level_coupling
    diagonal, gradient, coupling = (a[at.last_speed][:, None] * last for a in terms)
    half = diagonal[..., None] / 2 * last[:, None]
    half = half.at[..., at.one].add(gradient).at[..., LEVEL].add(coupling)
    return stages._replace(hessian=stages.hessian.at[:-1, -1].add(_symmetrised(half)), dynamics=dynamics)
