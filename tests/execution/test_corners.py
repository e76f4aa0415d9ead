"""Finger and palm make a closed corner, and friction is found whatever contacts touch."""

import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.execution.executions import run_schedule
from wholearm_jax.execution.mujoco_model import build_mujoco_model
from wholearm_jax.model import rigid_body
from wholearm_jax.phases.phase_ends import configuration


@pytest.fixture(scope="module")
def pressed_into_the_corner():
    """The bundled flight's last slide from just before its end, driven against finger 2's joint with 25 rad/s^2."""
    scene, step = wa.load("flight"), 2e-4
    dynamics = wa.trace(scene)[2].dynamics
    last = int(dynamics.count) - 1
    near = dynamics.breakpoints[0] + 0.98 * (dynamics.breakpoints[last + 1] - dynamics.breakpoints[0])
    start = np.asarray(configuration(dynamics, jnp.asarray(last), near))
    bodies = build_mujoco_model(scene, step)
    course, creep, _ = run_schedule(bodies, scene, start, np.tile([0.97, -0.12], (1000, 1)), step)
    return scene, bodies, course, creep


def test_a_vertex_pressed_into_the_corner_of_finger_and_palm_stays_there(pressed_into_the_corner):
    scene, _, course, _ = pressed_into_the_corner
    x, y, phi = course.z[-1, :3]
    corner = np.asarray(rigid_body(scene.object).vertices)[2]
    at = [x, y] + np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]]) @ corner
    moved = np.hypot(*(course.z[-1] - course.z[0])[:2])
    assert moved > 2e-4  # it came from before the corner
    np.testing.assert_allclose(at, np.asarray(scene.hand.joint)[1], atol=1e-5)
    assert np.abs(course.z_dot[-1]).max() < 1e-3


def test_forces_obey_coulombs_law_on_the_way_into_the_corner(pressed_into_the_corner):
    """Within their cones, but for three impacts in the corner, where no forces may agree with that law."""
    _, bodies, course, creep = pressed_into_the_corner
    most = bodies.friction * course.cn
    beyond = (np.abs(course.ct) - most).max(1) / most.max()
    assert (course.cn >= 0).all()
    assert (beyond > 1e-4).sum() <= 3
    assert beyond.max() < 1e-3
    assert creep < 1e-6
