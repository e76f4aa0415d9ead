r"""Riccati recursion: minimise a quadratic function subject to the linearised equations, backward over the knots.

The cost of all stages from one on is a quadratic form of that stage's state `z` (`lq_problem`),

    V(z) = 1/2 z^T V_zz z = min over u of [ stage(z, u) + V+(z+) ],

so each knot is eliminated by one matrix product and one 2x2 inverse, the last first:

    [Q S; S^T R] += [A B]^T V+ [A B],    K = R^-1 S^T,    V_zz = Q - S K,    u = -K z

The shared numbers and the first torques follow from the small system that remains. The time is proportional to the
number of knots.

Source: C. V. Rao, S. J. Wright and J. B. Rawlings, Application of interior-point methods to model predictive control,
Journal of Optimization Theory and Applications 99, 1998. Derivation: section 9 of `docs/derivation.md`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import fused_matmul
from wholearm_jax.optimisation.linearisation import (
    LinearisedProblem,
    gauss_newton_blocks,
    jacobian_transpose_product,
)
from wholearm_jax.optimisation.lq_problem import (
    LEVEL,
    TAU,
    LQStages,
    ParametricLQ,
    StageLayout,
    X,
    build_stages,
    stage_layout,
)

MIN_REGULARISATION = 1e-8  # of every step: variables that no inequality depends on stay where they are

LQSolution = tuple[Float[Array, "p"], Float[Array, ""], Float[Array, "e"]]  # variables, level, multipliers


def kkt_step(linear: LinearisedProblem, barrier_hessian, barrier_rhs, regularisation) -> LQSolution:
    """Solve the Newton system of the interior point for the steps of `p` and of the level `m`, and the multipliers `y`.

        (J^T S J + regularisation) p - J^T S a m + E^T y = J^T t
        a^T S a m - a^T S J p = 1 - a^T t,    E p = -e

    Args:
        linear: gives `J`, `E`, `e` and the mask `a` of the inequalities that the level lowers.
        barrier_hessian: diagonal of `S`, (phases, parts, inequalities).
        barrier_rhs: `t`, (phases, parts, inequalities).
        regularisation: keeps steps small along directions in which the objective hardly changes.
    """
    mask = linear.margin_mask
    hessian_of_level = barrier_hessian * mask
    quadratic = ParametricLQ(
        hessian_blocks=gauss_newton_blocks(linear, barrier_hessian),
        diagonal=jnp.full(linear.is_fixed.shape, MIN_REGULARISATION) + regularisation,
        gradient=-jacobian_transpose_product(linear, barrier_rhs),
        level_coupling=-jacobian_transpose_product(linear, hessian_of_level),
        level_hessian=hessian_of_level.sum(),
        level_gradient=-(1 - (mask * barrier_rhs).sum()),
    )
    return solve_lq(linear, quadratic)


def project_step(linear: LinearisedProblem, step: Float[Array, "p"]) -> Float[Array, "p"]:
    """Project a step of torques and durations onto those that close the linearised equations.

    Entries of states in `step` act as a gradient: that of a loss becomes the one by torques and durations alone.
    """
    zero = jnp.zeros(())
    step = jnp.where(linear.is_fixed, 0.0, step)
    quadratic = ParametricLQ(
        hessian_blocks=jnp.zeros((*linear.input_indices.shape, linear.input_indices.shape[-1])),
        diagonal=jnp.ones(linear.is_fixed.shape).at[linear.states].set(0.0),
        gradient=-step,
        level_coupling=jnp.zeros_like(step),
        level_hessian=zero + 1,
        level_gradient=zero,
    )
    return solve_lq(linear, quadratic)[0]


def solve_lq(linear: LinearisedProblem, quadratic: ParametricLQ) -> LQSolution:
    """Minimise a quadratic function under `E p = -e`: variables, level, and multipliers of the equations."""
    at, stages = stage_layout(linear.phases, linear.knots), build_stages(linear, quadratic)
    V_zz, K, V_rows = _backward_pass(at, stages, quadratic)

    # At the first knot the state is given, the torques are not.
    free = slice(TAU.start, at.one)
    first_torque, shared = jnp.split(jnp.linalg.solve(V_zz[free, free], -V_zz[free, at.one]), [2])
    shared = jnp.append(shared, 1.0)

    z, z_next = _forward_pass(at, stages, K, first_torque, shared)
    u = -jnp.einsum("kij,kj->ki", K, z)
    numbers = jnp.concatenate([z, u], axis=1).reshape(stages.hessian.shape[:3])
    costates = jnp.einsum("kij,kj->ki", V_rows, z_next).reshape(*numbers.shape[:2], 4)
    last_state = jnp.einsum("pij,pj->pi", stages.terminal[:, -1], numbers[:, -1])
    p = _variables(at, linear, numbers, last_state, shared)
    return p, shared[0], _multipliers(at, linear, quadratic, costates, last_state, shared)


def _backward_pass(at: StageLayout, stages: LQStages, quadratic: ParametricLQ):
    """Eliminate the knots from the last to the first.

    Returns `V_zz` at the first; and for each stage the gain `K` and the rows `V` of state and torques at the next.
    """
    size, one = at.size, at.one
    terminal = jnp.zeros((size, size)).at[LEVEL, LEVEL].set(quadratic.level_hessian)
    terminal = terminal.at[LEVEL, one].set(quadratic.level_gradient).at[one, LEVEL].set(quadratic.level_gradient)
    shared_rows = np.eye(size, size + 2)[LEVEL:]

    def eliminate(V_zz, stage):
        hessian, AB = stage
        AB = jnp.concatenate([AB, shared_rows])
        # Sums of products in place of library calls: so the loop is compiled as a whole.
        hessian = fused_matmul(AB.T, fused_matmul(V_zz, AB)) + hessian
        (a, b), (_, c) = hessian[size:, size:]  # R
        first, second = hessian[size:, :size]  # S^T
        K = jnp.stack([c * first - b * second, a * second - b * first]) / (a * c - b * b)
        return hessian[:size, :size] - first[:, None] * K[0] - second[:, None] * K[1], (K, V_zz[:LEVEL])

    by_stage = _in_turn(stages.hessian), _in_turn(stages.dynamics)
    V_zz, (K, V_rows) = jax.lax.scan(eliminate, terminal, by_stage, reverse=True)
    return V_zz, K, V_rows


def _forward_pass(at: StageLayout, stages: LQStages, K, first_torque, shared):
    """Follow the stages from the first knot to the last; returns `z` of each stage and of the next."""
    AB = _in_turn(stages.dynamics)
    closed_loop = AB[:, :, : at.size] - AB[:, :, at.size :] @ K
    constant = closed_loop[:, :, LEVEL:] @ shared
    begin = jnp.concatenate([jnp.zeros(2), first_torque])

    def follow(z, stage):
        return fused_matmul(stage[0], z) + stage[1], z

    end, knots = jax.lax.scan(follow, begin, (closed_loop[:, :, :LEVEL], constant))
    each = jnp.broadcast_to(shared, (knots.shape[0], shared.size))
    return [jnp.concatenate([z, each], axis=1) for z in (knots, jnp.concatenate([knots[1:], end[None]]))]


def _in_turn(stages):
    """Put the stages of all phases in one sequence."""
    return stages.reshape(-1, *stages.shape[2:])


def _variables(at: StageLayout, linear: LinearisedProblem, numbers, last_state, shared) -> Float[Array, "p"]:
    """Collect the changes of all variables from the stages."""
    torque = jnp.concatenate([numbers[:, :, TAU], numbers[:, -1:, at.size :]], axis=1)
    state = jnp.concatenate([numbers[:, :, X], last_state[:, None]], axis=1)
    durations = shared[at.durations.start - LEVEL : at.durations.stop - LEVEL]
    p = jnp.concatenate([torque.ravel(), state.ravel(), durations])
    return jnp.where(linear.is_fixed, 0.0, p)


def _multipliers(
    at: StageLayout, linear: LinearisedProblem, quadratic: ParametricLQ, costates, last_state, shared
) -> Float[Array, "e"]:
    """Collect the multipliers: each is the derivative of the cost of all later stages, `costates` at the next knot."""
    of_ends = shared[at.multipliers.start - LEVEL : at.multipliers.stop - LEVEL]
    defects = costates[:, :, X].at[:, -1, 0].set(of_ends[:-1]).at[-1, -1, 1].set(of_ends[-1])
    speed_linkage, torque_linkage = -costates[:-1, -1, 1], -costates[:-1, -1, TAU]
    # A last speed that is linked costs by itself, and by the speed that follows from it.
    v, coupling = at.last_speed, quadratic.level_coupling[at.last_speed] * shared[0]
    of_speed = quadratic.diagonal[v] * last_state[:-1, 1] + quadratic.gradient[v] + coupling
    of_speed = of_speed + linear.equality_jacobian[at.speed_linkage, v] * speed_linkage
    defects = defects.at[:-1, -1, 1].set(of_speed)
    return jnp.concatenate([defects.ravel(), speed_linkage, torque_linkage.ravel()])
