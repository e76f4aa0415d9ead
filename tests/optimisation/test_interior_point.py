"""The interior point on a double integrator with linear forces, whose optimum another solver knows."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from wholearm_jax.optimisation.constraints import Limits, fixed_variables, force_count, inequality_count
from wholearm_jax.optimisation.interior_point import MU_MIN, fraction_to_boundary, interior_point
from wholearm_jax.optimisation.linearisation import LinearisedProblem
from wholearm_jax.optimisation.variables import (
    interval_end_indices,
    interval_input_indices,
    state_slice,
    variable_count,
)

KNOTS = 6
INTERVALS = KNOTS - 1
FORCES = 4  # of each interval
SIZE = variable_count(1, KNOTS)
INPUTS, ENDS = interval_input_indices(1, KNOTS)[0], interval_end_indices(1, KNOTS)[0]


@pytest.fixture(scope="module")
def problem():
    """All constraints as `matrix @ p + constant`: inequalities by interval, and equations; and which variables stay."""
    rng = np.random.default_rng(8)
    step = 1 / INTERVALS
    by_torque = step * np.array([[2.0, -1.0, 1.0, -0.5], [6.0, -3.0, 6.0, -3.0]])
    end_jacobian = np.hstack([[[1.0, step], [0.0, 1.0]], by_torque, np.zeros((2, 1))])
    jacobian, constant = (
        np.zeros((INTERVALS, inequality_count(KNOTS), 7)),
        np.zeros((INTERVALS, inequality_count(KNOTS))),
    )
    weight = np.zeros_like(constant)
    jacobian[:, :FORCES, 2:6] = rng.normal(size=(INTERVALS, FORCES, 4))
    jacobian[:, :FORCES, :2] = 0.1 * rng.normal(size=(INTERVALS, FORCES, 2))
    constant[:, :FORCES] = 1.0
    limits = force_count(KNOTS) + np.arange(8)
    jacobian[:, limits, 2:6], constant[:, limits] = np.vstack([-np.eye(4), np.eye(4)]), 1.0
    weight[:, :FORCES], weight[:, limits] = step / FORCES, step / 32
    one, no_rows = jnp.ones(1), jnp.zeros((1, INTERVALS, 0, 5))
    fixed = jnp.zeros((1, KNOTS), bool)
    is_fixed = fixed_variables(Limits(jnp.full(2, jnp.inf), one, one, jnp.zeros(()), fixed, one, no_rows), 1, KNOTS)
    equations = np.zeros((2 * INTERVALS, SIZE))
    for k in range(INTERVALS):
        equations[2 * k : 2 * k + 2, INPUTS[k]] += end_jacobian
        equations[2 * k : 2 * k + 2, ENDS[k]] -= np.eye(2)
    return jacobian, constant, weight, end_jacobian, equations, np.asarray(is_fixed)


def linearised(problem, p):
    jacobian, constant, weight, end_jacobian, equations, is_fixed = problem
    value = jnp.einsum("kri,ki->kr", jacobian, p[INPUTS]) + constant
    return LinearisedProblem(
        inequality=value[None],
        inequality_jacobian=jnp.asarray(jacobian)[None],
        weight=jnp.asarray(weight)[None],
        margin_mask=jnp.asarray((np.arange(inequality_count(KNOTS)) < force_count(KNOTS)) * 1.0),
        interval_of_part=jnp.arange(INTERVALS)[None],
        defect=equations @ p,
        equality_jacobian=jnp.asarray(equations),
        end_jacobian=jnp.broadcast_to(end_jacobian, (1, INTERVALS, 2, 7)),
        is_fixed=jnp.asarray(is_fixed),
    )


@pytest.fixture(scope="module")
def begin():
    """A start between the given ends, whose intervals do not join and whose torques are partly beyond their limits."""
    state = np.stack([np.linspace(0.0, 1.0, KNOTS), np.r_[0.0, np.ones(KNOTS - 2), 0.0]], axis=1)
    p = jnp.zeros(SIZE).at[INPUTS[2, 2:6]].set(np.array([1.2, -1.1, 0.3, 1.05]))
    return p.at[state_slice(1, KNOTS)].set(state.ravel())


@pytest.fixture(scope="module")
def solution(problem, begin):
    method = interior_point(1, 0)

    @jax.jit
    def step(p, state):
        change, state = method.update(jnp.zeros(SIZE), state, p, linear=linearised(problem, p), regularisation=0.0)
        return p + change, state

    p, state = begin, method.init(begin)
    for _ in range(80):
        p, state = step(p, state)
    return p, state


def known_optimum(problem, begin):
    """The largest margin, by a solver of linear programmes in all variables and the margin."""
    jacobian, constant, weight, _, equations, is_fixed = problem
    rows, values = [], []
    for k, row in zip(*np.nonzero(weight), strict=True):
        full = np.zeros(SIZE + 1)
        full[INPUTS[k]], full[-1] = -jacobian[k, row], row < force_count(KNOTS)
        rows.append(full)
        values.append(constant[k, row])
    bounds = [(x, x) if stays else (None, None) for x, stays in zip(np.asarray(begin), is_fixed, strict=True)]
    cost, equal = np.append(np.zeros(SIZE), -1.0), np.hstack([equations, np.zeros((len(equations), 1))])
    answer = linprog(cost, np.array(rows), values, equal, np.zeros(len(equations)), [*bounds, (None, None)])
    assert answer.status == 0
    return -answer.fun


def test_it_ends_within_the_barrier_of_the_known_optimum(problem, begin, solution):
    p, state = solution
    best, weight = known_optimum(problem, begin), problem[2]
    assert 0.05 < best < 0.95, "forces and torque limits both matter"
    linear = linearised(problem, p)
    margin = float(linear.inequality[0, :, :FORCES].min())
    assert state.mu == MU_MIN
    assert best - MU_MIN * weight.sum() <= margin <= best + 1e-9
    assert best - MU_MIN * weight.sum() <= float(state.level) < margin
    np.testing.assert_allclose(linear.defect, 0.0, atol=1e-12)
    np.testing.assert_array_equal(p[problem[-1]], begin[problem[-1]])
    assert float(linear.inequality[linear.weight > 0].min()) > 0


def test_it_ends_on_the_central_path(problem, solution):
    p, state = solution
    linear = linearised(problem, p)
    exists = np.asarray(linear.weight) > 0
    slack = np.asarray(linear.inequality - linear.margin_mask * state.level)
    np.testing.assert_allclose(state.slack[exists], slack[exists], rtol=1e-9)
    np.testing.assert_allclose((state.slack * state.multiplier)[exists], MU_MIN * linear.weight[exists], rtol=1e-6)
    assert np.all(state.multiplier[~exists] == 0)
    assert float((state.multiplier * linear.margin_mask).sum()) == pytest.approx(1.0, rel=1e-9)
    # What is left of the gradient of the barrier is a combination of the equations.
    flat = np.zeros(SIZE)
    np.add.at(flat, INPUTS, np.einsum("kri,kr->ki", problem[0], state.multiplier[0]))
    moves = ~problem[-1]
    combination, *_ = np.linalg.lstsq(problem[4][:, moves].T, flat[moves], rcond=None)
    np.testing.assert_allclose(problem[4][:, moves].T @ combination, flat[moves], atol=1e-9)
    assert np.abs(combination).max() == pytest.approx(float(state.max_multiplier), rel=1e-6)


def test_a_step_stays_away_from_limits():
    reach = functools.partial(fraction_to_boundary, jnp.array([1.0, 2.0, 3.0]))
    assert reach(jnp.array([5.0, 0.0, -1.0])) == 1.0
    assert reach(jnp.array([-2.0, -1.0, 4.0])) == pytest.approx(0.95 * 0.5)
    assert reach(jnp.array([-1.0, -8.0, 4.0])) == pytest.approx(0.95 * 0.25)
