"""Pushes during an execution, and maps of what a law survives: closed forms, and one execution at a time."""

from pathlib import Path

import equinox as eqx
import matplotlib.pyplot as plt
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.execution import (
    build_mujoco_model,
    execute,
    friction_map,
    push,
    push_map,
    start_map,
)
from wholearm_jax.execution.executions import run_schedule
from wholearm_jax.execution.mujoco_model import ContactCompliance
from wholearm_jax.model import rigid_body
from wholearm_jax.plotting import plot_disturbance_map

STEP = 1e-3
TORQUE = Path(__file__).parents[1] / "data" / "heptagon_torque.csv"


@pytest.fixture(scope="module")
def prediction(scene):
    return wa.simulate(scene, wa.quasistatic(scene))


@pytest.fixture(scope="module")
def pushed(prediction, controller):
    """Two pushes at two times: the smaller by a tenth of what throws the object out of the hand."""
    return push_map(prediction, "phi", (2e-3, 0.02), (0.3, 0.6), controller=controller, workers=2, timestep=STEP)


@pytest.mark.parametrize("duration", [0.1 * STEP, 2.5 * STEP, 0.02])
@pytest.mark.parametrize("friction", ["coulomb", "convex"])
def test_a_push_gives_its_whole_impulse(scene, duration, friction):
    """Far from everything a body's momentum changes by the impulse, however long it lasts or a step is."""
    floating = eqx.tree_at(lambda s: (s.hand.dry, s.hand.viscous), scene, (np.zeros(2), np.zeros(2)))
    bodies = build_mujoco_model(floating, STEP, ContactCompliance(friction=friction))
    start = np.array([0.0, 1.0, 0.3, 1.0, 2.0])
    impulse = {"x": 0.02, "y": -0.01, "phi": 1e-4, "theta1": 2e-3}
    pushes = [push(0.01, duration=duration, **impulse), push(0.015, x=0.01)]
    count = 60
    course, _, _ = run_schedule(bodies, floating, start, np.zeros((count, 2)), STEP, pushes)
    still, _, _ = run_schedule(bodies, floating, start, np.zeros((count, 2)), STEP)
    body, link = rigid_body(floating.object), np.asarray(floating.hand.inertia)[0]
    expected = [0.03 / body.mass, -0.01 / body.mass, 1e-4 / body.inertia, 2e-3 / link, 0.0]
    np.testing.assert_allclose(course.z_dot[-1] - still.z_dot[-1], expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(course.z_dot[:11], still.z_dot[:11])  # row 11 is the state after its first step


def test_the_law_brings_back_what_was_pushed_and_says_what_it_lost(pushed):
    assert pushed.succeeds[0].all()
    assert not pushed.succeeds[1].any()


def test_a_map_is_made_of_single_executions(prediction, controller, pushed):
    assert (pushed.kind, pushed.columns) == ("push about phi [N m s]", (0.3, 0.6))
    for i, j, size, time in ((0, 1, 2e-3, 0.6), (1, 0, 0.02, 0.3)):
        pushes, seed = [push(time, phi=size)], 2 * i + j
        alone = execute(prediction, controller=controller, pushes=pushes, seed=seed, timestep=STEP)
        assert pushed.endings[i][j] == alone.ending.value
        assert pushed.runs[seed].own_position_error == pytest.approx(alone.position_error, abs=1e-6)


def test_maps_of_friction_and_start_change_one_thing_a_column(prediction, controller):
    rougher = friction_map(prediction, (1.1,), controller=controller, workers=2, timestep=STEP)
    assert rougher.columns == ("palm", "finger1", "finger2")
    assert rougher.succeeds.all()
    np.testing.assert_allclose([run.friction for run in rougher.runs], 1.0 + 0.1 * np.eye(3))
    moved = start_map(prediction, (1e-3,), controller=controller, workers=2, timestep=STEP)
    assert moved.columns == ("x", "y", "phi")
    assert moved.succeeds.shape == (1, 3)


def test_the_figure_has_a_mark_for_every_execution(pushed):
    ax = plot_disturbance_map(pushed, plt.figure().gca())
    assert sum(len(marks.get_offsets()) for marks in ax.collections) == 4
    assert ax.get_xlabel() == "begins at [s]"
    plt.close(ax.figure)


@pytest.mark.parametrize(
    ("time", "more", "says"),
    [
        (0.1, {"z": 1.0}, "z: the coordinates are x, y, phi"),
        (0.1, {}, "nothing"),
        (-0.1, {"x": 1.0}, "must not be negative"),
        (0.1, {"x": np.inf}, "finite"),
        (0.1, {"x": 1.0, "duration": 0.0}, "duration"),
    ],
)
def test_pushes_that_cannot_be_are_refused(time, more, says):
    with pytest.raises(ValueError, match=says):
        push(time, **more)


@pytest.mark.parametrize("text", ["0.1", "x@0.1", "x=0.1", "z=0.1@0.2", "x=a@0.1", "x=0.1@-1"])
def test_the_command_refuses_them_in_one_line(text, wholearm):
    code, out, err = wholearm("execute", "heptagon", "--torque", TORQUE, "--push", text)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"--push {text}: write COORDINATE=IMPULSE@TIME" in err


def test_the_command_says_when_an_encoder_may_have_opened_contacts(controller, wholearm, tmp_path):
    wa.write_controller(controller, tmp_path / "controller.json")
    options = ("--controller", tmp_path / "controller.json", "--perturb", "1", "--timestep", "0.001")
    _, out, err = wholearm("execute", "heptagon", *options, "--counts", "300")
    assert "all contacts kept on the way: 0" in out
    assert "though the law's least force is 0.347 N" in err
    assert "--counts 1200 tells" in err
    assert "stiffness=30, integral=5, observer=100" in err
    _, out, err = wholearm("execute", "heptagon", *options, "--counts", "0")
    assert "all contacts kept on the way: 1" in out
    assert "encoder" not in err
