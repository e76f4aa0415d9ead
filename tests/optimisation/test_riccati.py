"""The recursion solves the whole system: every equation is written out here, densely, and looked at."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.core.arrays import as_device_array
from wholearm_jax.optimisation.coupled_phases import stacked_tables
from wholearm_jax.optimisation.linearisation import Limits, linearise
from wholearm_jax.optimisation.multiple_shooting import Variables
from wholearm_jax.optimisation.riccati import SPREAD, kkt_step, project_step
from wholearm_jax.phases.plan_tracing import trace
from wholearm_jax.simulation.integrator import IntegratorOptions

KNOTS = 7

linearised, stepped = eqx.filter_jit(linearise), eqx.filter_jit(kkt_step)


def _problem(name, count, *, free):
    """A linearised problem of `count` phases at speed, its torques random; `free` lets durations change."""
    rng = np.random.default_rng(5)
    phase_dynamics = stacked_tables([at.dynamics for at in trace(wa.load(name))[:count]])
    evenly = np.broadcast_to(np.linspace(0.0, 1.0, KNOTS), (count, KNOTS))
    state = np.stack([evenly, rng.uniform(0.5, 1.5, (count, KNOTS))], axis=2)
    p = Variables(*map(as_device_array, (rng.uniform(-0.5, 0.5, (count, KNOTS, 2)), state, np.zeros(count))))
    one, pinned = np.ones(count), np.zeros((count, KNOTS), bool)
    pinned[0, 0] = True
    limits = Limits(
        *map(as_device_array, (np.full(2, 40.0), one / (2 if free else 1), one, np.asarray(0.2), pinned, one))
    )
    return linearised(p, phase_dynamics, limits, IntegratorOptions()), rng


def _dense(linear):
    """Derivatives of all rooms and of what must vanish by all variables but those that stay."""
    phases, parts, rooms, _ = linear.rates.room.shape
    size = 2 * phases * KNOTS
    jacobian = np.zeros((phases, parts, rooms, linear.still.size))
    for p, k in np.ndindex(phases, parts):
        at = 2 * (p * KNOTS + int(linear.interval_of_part[p, k]))
        places = [size + at, size + at + 1, at, at + 1, at + 2, at + 3, 2 * size + p]
        jacobian[p, k][:, places] = linear.rates.room[p, k]
    moves = ~np.asarray(linear.still)
    return jacobian.reshape(-1, moves.size) * moves, np.asarray(linear.across) * moves


@pytest.mark.parametrize(
    ("name", "count", "free"), [("heptagon", 1, False), ("heptagon", 1, True), ("flight", 3, True)]
)
def test_a_newton_step_solves_every_equation(name, count, free):
    linear, rng = _problem(name, count, free=free)
    assert np.all(np.isfinite(linear.at.room)), "the problem must be one that can be simulated"
    live = np.asarray(linear.weight) > 0
    stiff, aim = (np.where(live, rng.uniform(low, 1.0, live.shape), 0.0) for low in (0.1, -1.0))
    way, level, prices = stepped(linear, stiff, aim, 1e-3)
    jacobian, across = _dense(linear)
    bears = np.broadcast_to(linear.bears, live.shape).ravel()
    stiff, aim, moves = stiff.ravel(), aim.ravel(), ~np.asarray(linear.still)
    price = jacobian.T @ (stiff * (jacobian @ way - bears * level) - aim) + (1e-3 + SPREAD) * way
    size = np.abs(jacobian.T * stiff @ np.abs(jacobian @ way)).max()
    np.testing.assert_allclose((across.T @ prices + price)[moves], 0.0, atol=1e-9 * size)
    assert stiff @ bears * level - stiff * bears @ (jacobian @ way) == pytest.approx(1 - bears @ aim, rel=1e-9)
    np.testing.assert_allclose(across @ way, -linear.defect, atol=1e-9 * np.abs(linear.defect).max())
    assert np.all(way[~moves] == 0)
    assert np.abs(way[-count:]).max() > 0 or not free


@pytest.mark.parametrize(("name", "count"), [("heptagon", 1), ("flight", 3)])
def test_the_nearest_step_joins_and_what_it_leaves_is_normal_to_all_that_do(name, count):
    linear, rng = _problem(name, count, free=True)
    across, moves = _dense(linear)[1], ~np.asarray(linear.still)
    free = np.ones(moves.size, bool)
    free[2 * count * KNOTS : 4 * count * KNOTS] = False
    wanted = np.where(free, rng.normal(size=moves.size), 0.0)
    way = np.asarray(eqx.filter_jit(project_step)(linear, wanted))
    np.testing.assert_allclose(across @ way, -linear.defect, atol=1e-9 * np.abs(linear.defect).max())
    left = np.where(free & moves, way - wanted, 0.0)
    _, values, right = np.linalg.svd(across[:, moves])
    along = right[(values > 1e-9 * values[0]).sum() :]  # ways that stay joined
    np.testing.assert_allclose(along @ left[moves], 0.0, atol=1e-9 * np.linalg.norm(left))
    assert np.linalg.norm(left) > 0.01


def test_what_pulls_at_states_pulls_at_the_torques_that_they_follow():
    linear, rng = _problem("flight", 3, free=True)
    across, moves = _dense(linear)[1], ~np.asarray(linear.still)
    joined = linear._replace(defect=jnp.zeros_like(linear.defect))
    pull = rng.normal(size=moves.size)
    way = np.asarray(eqx.filter_jit(project_step)(joined, pull))
    free = np.ones(moves.size)
    free[2 * 3 * KNOTS : 4 * 3 * KNOTS] = 0.0
    _, values, right = np.linalg.svd(across[:, moves])
    along = right[(values > 1e-9 * values[0]).sum() :]
    left = free * way - pull  # the gradient of |torques and durations|^2 / 2 - pull.p
    np.testing.assert_allclose(along @ left[moves], 0.0, atol=1e-9 * np.linalg.norm(left))
