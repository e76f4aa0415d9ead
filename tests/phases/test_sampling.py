"""Trajectories: what is sampled is the motion, also where a phase ends before its time."""

import equinox as eqx
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.model.scene import Arrival, replace_duration
from wholearm_jax.phases.sampling import Trajectory

SAMPLES = 401


def assert_moves_as_it_says(course):
    """Differences of `z` are `z_dot`, but for what they miss where an acceleration jumps."""
    step = np.diff(course.time)[0]
    off = np.abs((course.z[2:] - course.z[:-2]) / (2 * step) - course.z_dot[1:-1])
    largest = np.abs(course.z_dot).max(0)
    np.testing.assert_array_less(off.max(0), 2e-2 * largest + 1e-9)
    np.testing.assert_array_less(np.median(off, axis=0), 1e-4 * largest + 1e-9)


@pytest.fixture(scope="module")
def early():
    """A phase that is pushed to its path's end in half of its time, and caught there."""
    found = wa.search_by_steps(layered("hexagon"))
    phase = found.scene.phases[0]
    taken = float(phase.duration)
    scene = eqx.tree_at(lambda s: s.phases, found.scene, (replace_duration(phase, 2 * taken),))
    torque = wa.torque_schedule([0.0, 2 * taken], [found.torque.values[0]] * 2)
    result = wa.simulate(scene, torque)
    assert result.status is wa.Status.OK, result.message
    return result, taken


def test_who_is_caught_early_rests_where_the_path_ends(early):
    result, taken = early
    (course,) = wa.trajectory(result, SAMPLES)
    moves, rests = course.time < taken - 1e-6, course.time > taken + 1e-6
    assert moves.sum() >= SAMPLES // 2
    assert rests.sum() >= SAMPLES // 2
    assert np.all(course.z_dot[rests] == 0)
    assert np.all(np.isnan(course.cn[rests]))
    assert np.all(np.abs(course.z_dot[moves][1:]).max(1) > 0)
    assert np.all(np.isfinite(course.cn[moves]))
    np.testing.assert_allclose(course.z[rests] - course.z[-1], 0.0, atol=1e-12)
    assert_moves_as_it_says(Trajectory(*(column[moves] for column in course)))


def test_phases_that_pass_on_at_speed_are_sampled_until_they_do():
    result = wa.optimise(layered("flight")).result
    assert result.status is wa.Status.OK, result.message
    courses = wa.trajectory(result, SAMPLES)
    for phase, course in zip(result.phases, courses, strict=True):
        assert_moves_as_it_says(course)
        end = phase.time if phase.arrive is Arrival.MOVING else phase.start + phase.duration
        assert course.time[-1] == pytest.approx(end)
    for before, after, phase in zip(courses, courses[1:], result.phases, strict=False):
        assert phase.arrive is Arrival.MOVING
        assert after.time[0] == pytest.approx(before.time[-1])
        np.testing.assert_allclose(after.z[0], before.z[-1], atol=1e-8)
        np.testing.assert_allclose(phase.outcome.exit_velocity, before.z_dot[-1], rtol=1e-8, atol=1e-10)


def test_torques_are_those_of_the_schedule_while_the_object_waits():
    """A wait is one step of the motion, however many knots the schedule has meanwhile."""
    scene = layered("heptagon")
    push = wa.quasistatic(scene)
    weak = np.asarray(push.values)[:1] * np.array([0.1, 0.3, 0.05, 0.2])[:, None]
    times = np.concatenate([[0.0, 0.1, 0.2, 0.3, 0.3], [1.0, 1.0, 2.0]])
    values = np.concatenate([weak, [push.values[0]] * 2, [push.values[-1]] * 2])
    result = wa.simulate(scene, wa.torque_schedule(times, values))
    assert result.phases[0].holds, "it must wait"
    course, *_ = wa.trajectory(result, SAMPLES)
    inside = np.abs(np.subtract.outer(course.time, [0.3, 1.0])).min(1) > 1e-9  # between the steps
    for joint in range(2):
        expected = np.interp(course.time, times, values[:, joint])
        np.testing.assert_allclose(course.torque[inside, joint], expected[inside], atol=1e-12)
