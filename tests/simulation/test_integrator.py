"""Steps by their error: they end on knots, keep their length across them, and stop at the first that comes past."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.model.schedule import restrict_to_phase
from wholearm_jax.simulation import (
    Adjoint,
    IntegratorOptions,
    TerminalEvent,
    integrate_adaptive,
    integrate_with_replay_adjoint,
    replay_steps,
)

NEVER = -jnp.inf


def spring(share, y, row):
    """`s'' = -9 s`."""
    return jnp.stack([y[1], -9.0 * y[0]])


def stop_at(past, longest=jnp.inf):
    """Stop where `s` falls below `past`; steps longer than `longest` may have been there."""
    return TerminalEvent(lambda y: y[0] < past, lambda y, after, rates, width: width > longest)


def steps_of(knots, *, past=NEVER, longest=jnp.inf, **options):
    """Steps from 0 to 1 of a schedule with these knots, from `s = 1` at rest."""
    schedule = wa.torque_schedule(knots, np.zeros((len(knots), 2)))
    phase_schedule, options = restrict_to_phase(schedule, jnp.zeros(()), jnp.ones(())), IntegratorOptions(**options)
    one = jnp.ones(())
    y = jnp.stack([one, 0 * one])
    steps = jax.jit(
        lambda y: integrate_adaptive(spring, phase_schedule, options, 0 * one, one, y, stop_at(past, longest), one)
    )(y)
    return steps, phase_schedule, options, y


def test_steps_end_on_every_knot_and_on_the_end():
    knots = [0.0, 0.013, 0.21, 0.2100001, 0.7, 1.0]
    steps, *_ = steps_of(knots, tolerance=1e-12)
    count = int(steps.count)
    assert bool(steps.complete)
    assert not bool(steps.passed)
    assert set(knots[1:]) <= set(np.asarray(steps.end[:count]).tolist())
    assert np.all(np.diff(steps.end[:count]) > 0)
    assert np.asarray(steps.y[count - 1]) == pytest.approx([np.cos(3.0), -3 * np.sin(3.0)], abs=1e-11)
    inside = np.searchsorted(knots, (np.append(0.0, steps.end[: count - 1]) + steps.end[:count]) / 2) - 1
    np.testing.assert_array_equal(steps.row[:count], inside)


def test_a_sliver_before_a_knot_does_not_make_the_steps_after_it_short():
    plain, *_ = steps_of([0.0, 0.5, 1.0])
    sliver, *_ = steps_of([0.0, 0.5, 0.5 + 1e-13, 1.0])
    assert int(sliver.count) == int(plain.count) + 1


def test_the_first_step_that_comes_past_is_the_last():
    steps, *_ = steps_of([0.0, 1.0], past=0.3)
    count = int(steps.count)
    assert bool(steps.passed)
    assert bool(steps.complete)
    assert np.all(steps.y[: count - 1, 0] >= 0.3)
    assert steps.y[count - 1, 0] < 0.3


def test_steps_that_may_have_been_past_are_taken_by_halves():
    """Those that follow grow again, to be halved again."""
    knots = [0.0, 1.0]
    (free, *_), (held, *_) = steps_of(knots, tolerance=1e-4), steps_of(knots, tolerance=1e-4, longest=0.1)
    widths = [np.diff(np.append(0.0, s.end[: int(s.count)])) for s in (free, held)]
    assert widths[0].max() > 0.2
    assert 0.05 <= widths[1].max() <= 0.1
    assert bool(held.complete)
    assert np.asarray(held.y[int(held.count) - 1]) == pytest.approx([np.cos(3.0), -3 * np.sin(3.0)], abs=1e-4)


def test_rates_at_the_ends_of_steps_are_the_field_s():
    """By a solver that knows them and by one that does not: given to the stop times the step's width."""
    for solver in (dfx.Dopri8(), dfx.Ralston()):
        phase_schedule = []

        def between(y, after, rates, width, phase_schedule=phase_schedule):
            jax.debug.callback(lambda *each: phase_schedule.append(each), y, after, *rates, width)
            return width < 0

        schedule = restrict_to_phase(wa.torque_schedule([0.0, 1.0], np.zeros((2, 2))), jnp.zeros(()), jnp.ones(()))
        options, one = IntegratorOptions(solver=solver, tolerance=1e-3), jnp.ones(())
        stop = TerminalEvent(lambda y: y[0] < NEVER, between)
        jax.block_until_ready(
            integrate_adaptive(spring, schedule, options, 0 * one, one, jnp.stack([one, 0 * one]), stop, one)
        )
        assert len(phase_schedule) > 2
        for y, after, first, last, width in phase_schedule:
            np.testing.assert_allclose(first, width * spring(0, y, 0), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(last, width * spring(0, after, 0), rtol=1e-12, atol=1e-12)


def test_steps_that_run_out_are_not_complete():
    steps, *_ = steps_of(np.linspace(0.0, 1.0, 33), max_steps=16)
    assert int(steps.count) == 16
    assert not bool(steps.complete)


MATRIX = np.array([[np.cos(3.0), np.sin(3.0) / 3], [-3 * np.sin(3.0), np.cos(3.0)]])  # of the spring over time 1


@pytest.mark.parametrize("adjoint", ["forward", "both"])
def test_repeated_steps_are_those_found_and_have_derivatives(adjoint):
    steps, phase_schedule, options, y = steps_of([0.0, 0.4, 1.0], tolerance=1e-12)
    options = IntegratorOptions(tolerance=1e-12, adjoint=adjoint)

    def end(y):
        again = replay_steps(spring, phase_schedule, options, jnp.zeros(()), jnp.ones(()), y, steps)
        return again.y[steps.count - 1]

    np.testing.assert_array_equal(end(y), steps.y[steps.count - 1])
    np.testing.assert_allclose(jax.jacfwd(end)(y), MATRIX, atol=1e-11)
    if adjoint == "both":
        np.testing.assert_allclose(jax.jacrev(end)(y), MATRIX, atol=1e-11)


def spring_of(stiffness, phase_schedule):
    return lambda share, y, row: jnp.stack([y[1], -stiffness * y[0]])


def test_steps_are_gone_back_over():
    """From their end to a state, a parameter and the time of their beginning; modes that it would get wrong raise."""
    steps, phase_schedule, _, y = steps_of([0.0, 0.4, 1.0], tolerance=1e-12)
    options = IntegratorOptions(tolerance=1e-12, adjoint=Adjoint.REVERSE)

    def end(y, stiffness=9.0, begin=0.0):
        inputs = jnp.asarray(stiffness), phase_schedule, jnp.asarray(begin), y
        one = jnp.ones(())
        found = integrate_with_replay_adjoint(inputs, spring_of, stop_at, options, one, -10 * one, one)
        return found.y[found.count - 1]

    np.testing.assert_array_equal(end(y), steps.y[steps.count - 1])
    by_state, by_stiffness, by_begin = jax.jacrev(end, (0, 1, 2))(y, 9.0, 0.0)
    np.testing.assert_allclose(by_state, MATRIX, atol=1e-11)
    # y(t) = y0 cos(w t) + v0 sin(w t) / w with w^2 the stiffness, by w at w = 3, t = 1, over 2 w
    y0, v0, w = *np.asarray(y), 3.0
    cos, sin = np.cos(w), np.sin(w)
    by_w = [-y0 * sin + v0 * (cos / w - sin / w**2), -y0 * (sin + w * cos) - v0 * sin]
    np.testing.assert_allclose(by_stiffness, np.array(by_w) / (2 * w), atol=1e-11)
    np.testing.assert_allclose(by_begin, -MATRIX @ np.array([v0, -w * w * y0]), atol=1e-10)
    with pytest.raises(TypeError, match="forward-mode autodiff"):
        jax.jacfwd(end)(y)
    with pytest.raises(RuntimeError, match="cannot be autodifferentiated"):
        jax.jacfwd(jax.jacrev(end))(y)
