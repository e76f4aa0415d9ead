"""A step that ends on an event does so exactly, carries the event's derivatives, and says when there is none."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.dynamics import placeholder_dynamics
from wholearm_jax.model import restrict_to_phase
from wholearm_jax.simulation import IntegratorOptions
from wholearm_jax.simulation.event_step import step_to_event
from wholearm_jax.simulation.path_ode import PathODE
from wholearm_jax.simulation.phase_motion import _terminal_event
from wholearm_jax.tracing import Resolution

BEGIN, END, DURATION = 0.25, 0.75, 2.0  # phase times of the step, seconds of the phase


@cache
def program():
    """A step under a constant acceleration: `s'' = a` in seconds, `T^2 a` in phase time."""
    empty = placeholder_dynamics(Resolution(segments=2, panels=2, nodes=4))
    schedule = restrict_to_phase(wa.torque_schedule([0.0, DURATION], np.zeros((2, 2))), jnp.zeros(()), DURATION)

    def step(acceleration, s, w, s_stop, w_stop, is_needed):
        dynamics = eqx.tree_at(lambda d: d.acceleration, empty, empty.acceleration.at[:, 0, 0].set(acceleration))
        ode, zero = PathODE(dynamics, schedule, jnp.asarray(DURATION)), jnp.asarray(0)
        start = jnp.asarray(BEGIN), s, w, None
        return step_to_event(ode, IntegratorOptions(), zero, zero, start, END, s_stop, w_stop, is_needed)

    return jax.jit(step), jax.jit(jax.jacfwd(lambda *args: step(*args, jnp.asarray(True))[:3], (0, 1, 2, 3)))


def event_of(acceleration, s, w, s_stop, w_stop=0.0, is_needed=True):
    arguments = [jnp.asarray(a) for a in (acceleration, s, w, s_stop, w_stop, is_needed)]
    return jax.tree.map(float, program()[0](*arguments))


def test_it_ends_where_the_segment_does():
    a, w = 0.7, 0.4
    found, rate = event_of(a, 0.0, w, 0.3), DURATION**2 * a
    w_end = np.sqrt(w**2 + 2 * rate * 0.3)
    assert (found.at_stop, found.failed, found.s) == (1.0, 0.0, 0.3)
    assert found.phase_time == pytest.approx(BEGIN + (w_end - w) / rate, abs=1e-15)
    assert found.w == pytest.approx(w_end, abs=1e-14)


def test_it_ends_at_rest_before_the_segment_does():
    a, w = -0.7, 0.4
    found, rate = event_of(a, 0.0, w, 0.3), DURATION**2 * a
    assert (found.at_stop, found.failed, found.w) == (0.0, 0.0, 0.0)
    assert found.phase_time == pytest.approx(BEGIN - w / rate, abs=1e-15)
    assert found.s == pytest.approx(-(w**2) / (2 * rate), abs=1e-15)


def test_the_event_s_derivatives_are_those_of_the_closed_form():
    a, w, s_stop = (jnp.asarray(x) for x in (0.7, 0.4, 0.3))

    def exact(a, s, w, s_stop):
        w_end = jnp.sqrt(w**2 + 2 * DURATION**2 * a * (s_stop - s))
        return BEGIN + (w_end - w) / (DURATION**2 * a), s_stop, w_end

    zero = jnp.zeros(())
    found = program()[1](a, zero, w, s_stop, zero)
    wanted = jax.jacfwd(exact, (0, 1, 2, 3))(a, zero, w, s_stop)
    np.testing.assert_allclose(jnp.array(found), jnp.array(wanted), rtol=1e-12, atol=1e-13)


def test_a_step_that_meets_no_event_fails_and_one_that_is_not_needed_has_no_length():
    assert event_of(0.0, 0.0, 0.4, 0.9).failed
    still = event_of(0.0, 0.0, 0.4, 0.9, is_needed=False)
    assert (still.phase_time, still.failed) == (BEGIN, 0.0)


@pytest.mark.parametrize(("depth", "crosses"), [(2.8, False), (4.8, True)])
def test_a_rest_between_the_ends_of_a_step_is_noticed(depth, crosses):
    """The speed `1 - depth u (1 - u)` is 1 at both ends, and in the middle 0.3 or -0.2."""
    y, y_end = jnp.array([0.0, 1.0]), jnp.array([1.0 - depth / 6, 1.0])
    rates = jnp.array([1.0, -depth]), jnp.array([1.0, depth])
    event = _terminal_event((jnp.asarray(10.0), jnp.asarray(0.0), 1e-10))
    assert not bool(event.is_past(y_end))
    assert bool(event.may_cross_within(y, y_end, rates, jnp.asarray(1.0))) is crosses
