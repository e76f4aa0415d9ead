"""Initial guesses: motions between their ends, and the torques that produce them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

from wholearm_jax.margin import acceleration_terms
from wholearm_jax.optimisation.constraints import linkage_defects
from wholearm_jax.optimisation.coupled_phases import stack_dynamics
from wholearm_jax.optimisation.initial_guess import TRANSITION_SPEEDS, initial_guesses
from wholearm_jax.phases import trace

KNOTS, DURATION, FRACTION = 1001, 0.8, 0.9


@pytest.fixture(scope="module", params=[0, 1])
def single(request):
    """A phase of the heptagon and its guesses."""
    dynamics = trace(layered("heptagon"))[request.param].dynamics
    return dynamics, initial_guesses([dynamics], [DURATION], KNOTS, FRACTION)


@pytest.fixture(scope="module")
def coupled():
    """The phases of the flight, and their guesses."""
    phase_dynamics = [traced.dynamics for traced in trace(layered("flight"))]
    durations = np.array([0.5, 0.7, 0.6])[: len(phase_dynamics)]
    return phase_dynamics, durations, initial_guesses(phase_dynamics, durations, KNOTS, FRACTION)


def test_a_single_phase_goes_forward_from_rest_to_rest(single):
    _, guesses = single
    assert len(guesses) == 1
    u = np.linspace(0.0, 1.0, KNOTS)
    for guess in guesses:
        assert guess.torque.shape == (1, KNOTS, 2)
        s, v = np.asarray(guess.state[0]).T
        assert (s[0], s[-1], v[0], v[-1]) == pytest.approx((0.0, 1.0, 0.0, 0.0), abs=1e-9)
        assert np.all(v[1:-1] > 0)
        area = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(u))])
        np.testing.assert_allclose(s, area, atol=1e-4)
        assert np.exp(guess.log_duration[0]) == pytest.approx(DURATION)
        assert np.abs(guess.torque).max() <= FRACTION


def test_torques_produce_the_motion(single):
    """The acceleration under them is that of the speed, by differences, wherever torques within limits allow it."""
    dynamics, guesses = single
    length, limit = float(dynamics.length), np.asarray(dynamics.torque_limit)
    terms_of = jax.jit(jax.vmap(lambda s: acceleration_terms(dynamics, s)))
    for number, guess in enumerate(guesses):
        s, v = np.asarray(guess.state[0]).T
        terms = np.asarray(terms_of(dynamics.breakpoints[0] + length * jnp.asarray(s)))
        speed = length * v / DURATION
        without_torque = terms[:, 0] + terms[:, 1] * speed**2 + terms[:, 2] * speed
        acceleration = without_torque + (terms[:, 3:] * limit * guess.torque[0]).sum(1)
        by_differences = length / DURATION**2 * np.gradient(v, 1 / (KNOTS - 1))
        possible = np.abs(by_differences - without_torque) <= FRACTION * (np.abs(terms[:, 3:]) * limit).sum(1)
        assert possible.all() if number == 0 else possible.mean() > 0.95
        possible[[0, -1]] = False  # differences are one-sided
        off = (acceleration - by_differences)[possible]
        np.testing.assert_allclose(off, 0.0, atol=1e-3 * np.abs(by_differences).max())


def test_coupled_phases_follow_one_another_at_speed(coupled):
    phase_dynamics, durations, guesses = coupled
    assert len(guesses) == len(TRANSITION_SPEEDS)
    count = len(phase_dynamics)
    for guess, speed in zip(guesses, TRANSITION_SPEEDS, strict=True):
        state = np.asarray(guess.state)
        np.testing.assert_allclose(state[:, [0, -1], 0], np.tile([0.0, 1.0], (count, 1)), atol=1e-12)
        assert state[0, 0, 1] == state[-1, -1, 1] == 0.0
        np.testing.assert_allclose(state[:-1, -1, 1], speed)
        assert np.all(state[1:, 0, 1] >= 0)
        np.testing.assert_allclose(np.exp(guess.log_duration), durations)
        # Speeds after impacts follow, unless a cubic motion with them would go back.
        linkage = np.asarray(linkage_defects(guess, stack_dynamics(phase_dynamics)))[: count - 1]
        follows = (state[1:, 0, 1] > 0) & (state[1:, 0, 1] < 2.9)
        assert follows.any()
        np.testing.assert_allclose(linkage[follows], 0.0, atol=1e-9)
