"""The condensed Newton step solves the whole system: every equation is written out here, densely, and looked at."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.condensing import SPREAD, following, newton_step
from wholearm_jax.group import stacked_tables
from wholearm_jax.linearisation import Limits, linearise
from wholearm_jax.plan import trace
from wholearm_jax.precision import array
from wholearm_jax.shooting import Variables
from wholearm_jax.stepping import Integration

KNOTS = 7

linearised, stepped = eqx.filter_jit(linearise), eqx.filter_jit(newton_step)


def _problem(name, count, *, free):
    """A linearised problem of `count` phases at speed, its torques random; `free` lets durations change."""
    rng = np.random.default_rng(5)
    tables = stacked_tables([at.table for at in trace(wa.load(name))[:count]])
    evenly = np.broadcast_to(np.linspace(0.0, 1.0, KNOTS), (count, KNOTS))
    state = np.stack([evenly, rng.uniform(0.5, 1.5, (count, KNOTS))], axis=2)
    p = Variables(*map(array, (rng.uniform(-0.5, 0.5, (count, KNOTS, 2)), state, np.zeros(count))))
    one, pinned = np.ones(count), np.zeros((count, KNOTS), bool)
    pinned[0, 0] = True
    limits = Limits(*map(array, (np.full(2, 40.0), one / (2 if free else 1), one, np.asarray(0.2), pinned, one)))
    return linearised(p, tables, limits, Integration()), rng


def _dense(linear):
    """Derivatives of all rooms and of what must vanish by all variables but those that stay."""
    phases, parts, rooms, _ = linear.rates.room.shape
    size = 2 * phases * KNOTS
    jacobian = np.zeros((phases, parts, rooms, linear.still.size))
    for p, k in np.ndindex(phases, parts):
        at = 2 * (p * KNOTS + int(linear.owner[p, k]))
        places = [size + at, size + at + 1, at, at + 1, at + 2, at + 3, 2 * size + p]
        jacobian[p, k][:, places] = linear.rates.room[p, k]
    moves = ~np.asarray(linear.still)
    return jacobian.reshape(-1, moves.size) * moves, np.asarray(linear.across) * moves


@pytest.mark.parametrize(
    ("name", "count", "free"), [("heptagon", 1, False), ("heptagon", 1, True), ("flight", 3, True)]
)
def test_a_condensed_step_solves_every_equation(name, count, free):
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


def test_states_follow_torques_as_the_linearised_intervals_say():
    linear, rng = _problem("flight", 3, free=True)
    follow, size = following(linear), 2 * 3 * KNOTS
    u = np.where(np.delete(np.asarray(linear.still), np.s_[size : 2 * size]), 0.0, rng.normal(size=size + 3))
    states = follow.matrix @ u + follow.apart
    way = jnp.concatenate([u[:size], states, u[size:]])
    joins = slice(0, 2 * 3 * (KNOTS - 1) + 2)
    np.testing.assert_allclose((linear.across @ way + linear.defect)[joins], 0.0, atol=1e-9)
