"""The Riccati recursion solves the whole system: every equation is written out here as a dense one, and checked."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

from wholearm_jax.core.arrays import as_device_array
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.coupled_phases import stack_dynamics
from wholearm_jax.optimisation.linearisation import linearise
from wholearm_jax.optimisation.riccati import MIN_REGULARISATION, kkt_step, project_step
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.phases.plan_tracing import trace
from wholearm_jax.simulation import IntegratorOptions

KNOTS = 7

linearise_jit, kkt_step_jit = eqx.filter_jit(linearise), eqx.filter_jit(kkt_step)


def _problem(name, count, *, free):
    """A linearised problem of `count` phases at speed, its torques random; `free` lets durations change."""
    rng = np.random.default_rng(5)
    phase_dynamics = stack_dynamics([at.dynamics for at in trace(layered(name))[:count]])
    places = np.broadcast_to(np.linspace(0.0, 1.0, KNOTS), (count, KNOTS))
    state = np.stack([places, rng.uniform(0.5, 1.5, (count, KNOTS))], axis=2)
    p = Variables(*map(as_device_array, (rng.uniform(-0.5, 0.5, (count, KNOTS, 2)), state, np.zeros(count))))
    one, fixed, no_rows = np.ones(count), np.zeros((count, KNOTS), bool), np.zeros((count, KNOTS - 1, 0, 5))
    fixed[0, 0] = True
    limits = Limits(
        *map(as_device_array, (np.full(2, 40.0), one / (2 if free else 1), one, np.asarray(0.2), fixed, one, no_rows))
    )
    return linearise_jit(p, phase_dynamics, limits, IntegratorOptions()), rng


def _dense(linear):
    """Jacobians of the inequalities and equalities by all variables, zero for fixed ones."""
    phases, parts, inequalities, _ = linear.inequality_jacobian.shape
    size = 2 * phases * KNOTS
    jacobian = np.zeros((phases, parts, inequalities, linear.is_fixed.size))
    for p, k in np.ndindex(phases, parts):
        at = 2 * (p * KNOTS + int(linear.interval_of_part[p, k]))
        columns = [size + at, size + at + 1, at, at + 1, at + 2, at + 3, 2 * size + p]
        jacobian[p, k][:, columns] = linear.inequality_jacobian[p, k]
    moves = ~np.asarray(linear.is_fixed)
    return jacobian.reshape(-1, moves.size) * moves, np.asarray(linear.equality_jacobian) * moves


@pytest.mark.parametrize(
    ("name", "count", "free"), [("heptagon", 1, False), ("heptagon", 1, True), ("flight", 3, True)]
)
def test_a_newton_step_solves_every_equation(name, count, free):
    linear, rng = _problem(name, count, free=free)
    assert np.all(np.isfinite(linear.inequality)), "the problem must be one that can be simulated"
    live = np.asarray(linear.weight) > 0
    hessian, rhs = (np.where(live, rng.uniform(low, 1.0, live.shape), 0.0) for low in (0.1, -1.0))
    step, level, multipliers = kkt_step_jit(linear, hessian, rhs, 1e-3)
    jacobian, across = _dense(linear)
    mask = np.broadcast_to(linear.margin_mask, live.shape).ravel()
    hessian, rhs, moves = hessian.ravel(), rhs.ravel(), ~np.asarray(linear.is_fixed)
    gradient = jacobian.T @ (hessian * (jacobian @ step - mask * level) - rhs) + (1e-3 + MIN_REGULARISATION) * step
    size = np.abs(jacobian.T * hessian @ np.abs(jacobian @ step)).max()
    np.testing.assert_allclose((across.T @ multipliers + gradient)[moves], 0.0, atol=1e-9 * size)
    assert hessian @ mask * level - hessian * mask @ (jacobian @ step) == pytest.approx(1 - mask @ rhs, rel=1e-9)
    np.testing.assert_allclose(across @ step, -linear.defect, atol=1e-9 * np.abs(linear.defect).max())
    assert np.all(step[~moves] == 0)
    assert np.abs(step[-count:]).max() > 0 or not free


@pytest.mark.parametrize(("name", "count"), [("heptagon", 1), ("flight", 3)])
def test_a_projected_step_closes_the_defects_and_its_change_is_normal_to_all_steps_that_do(name, count):
    linear, rng = _problem(name, count, free=True)
    across, moves = _dense(linear)[1], ~np.asarray(linear.is_fixed)
    free = np.ones(moves.size, bool)
    free[2 * count * KNOTS : 4 * count * KNOTS] = False
    asked = np.where(free, rng.normal(size=moves.size), 0.0)
    step = np.asarray(eqx.filter_jit(project_step)(linear, asked))
    np.testing.assert_allclose(across @ step, -linear.defect, atol=1e-9 * np.abs(linear.defect).max())
    left = np.where(free & moves, step - asked, 0.0)
    _, values, right = np.linalg.svd(across[:, moves])
    along = right[(values > 1e-9 * values[0]).sum() :]  # directions that keep the equations
    np.testing.assert_allclose(along @ left[moves], 0.0, atol=1e-9 * np.linalg.norm(left))
    assert np.linalg.norm(left) > 0.01


def test_a_gradient_by_states_becomes_one_by_torques_and_durations():
    linear, rng = _problem("flight", 3, free=True)
    across, moves = _dense(linear)[1], ~np.asarray(linear.is_fixed)
    joined = eqx.tree_at(lambda each: each.defect, linear, jnp.zeros_like(linear.defect))
    gradient = rng.normal(size=moves.size)
    step = np.asarray(eqx.filter_jit(project_step)(joined, gradient))
    free = np.ones(moves.size)
    free[2 * 3 * KNOTS : 4 * 3 * KNOTS] = 0.0
    _, values, right = np.linalg.svd(across[:, moves])
    along = right[(values > 1e-9 * values[0]).sum() :]
    left = free * step - gradient  # the gradient of |torques and durations|^2 / 2 - gradient.p
    np.testing.assert_allclose(along @ left[moves], 0.0, atol=1e-9 * np.linalg.norm(left))
