"""How exact torques must be: against free bodies that are driven by wrong ones, and what the optimiser makes of it."""

import tomllib
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from support import optimised

import wholearm_jax as wa
from wholearm_jax.execution import execute
from wholearm_jax.model import replace_duration
from wholearm_jax.optimisation.coupled_phases import FOLLOWABLE_ACCURACY

ARROW = Path(__file__).parents[1] / "data" / "arrow.toml"


@pytest.fixture(scope="module")
def arrow():
    scene = wa.load(ARROW)
    return scene, wa.trace(scene)


def optimised_at(arrow, durations):
    scene, traced = arrow
    phases = tuple(replace_duration(*one) for one in zip(scene.phases, durations, strict=True))
    return wa.optimise(eqx.tree_at(lambda s: s.phases, scene, phases), traced=traced)


@pytest.mark.parametrize("signs", [(1.0, -1.0), (-1.0, 1.0)])
def test_free_bodies_end_where_they_should_up_to_that_error(signs):
    """A third of the error is harmless; three times as much is not, either way."""
    found = optimised("tipping")
    least = min(wa.torque_accuracy(found.result))
    assert 1e-3 < least < 1e-2
    endings = []
    for error in (least / 3, 3 * least):
        wrong = np.asarray(found.torque.values) * (1 + error * np.array(signs))
        driven = replace(found.result, torque=wa.torque_schedule(found.torque.times, wrong))
        endings.append(execute(driven, timestep=4e-4).ending.value)
    assert endings[0] == "ok"
    assert endings[1] != "ok"


def test_tolerances_are_in_proportion():
    """To first order: ten times the distance and angle allow ten times the error."""
    result = optimised("tipping").result
    wide = wa.torque_accuracy(result, position=5e-3, angle=0.1)
    np.testing.assert_allclose(wide, 10 * np.array(wa.torque_accuracy(result)), rtol=1e-12)


def test_a_hold_needs_none_and_what_fails_has_none(arrow):
    scene, traced = arrow
    hold = {"name": "stay", "contacts": ["palm:v2", "palm:v3", "finger1:e3", "finger2:e1"], "hold": True}
    content = tomllib.loads(ARROW.read_text())
    content["phase"] = [hold | {"duration": 1.0}]
    found = wa.optimise(wa.parse(content))
    assert found.result.status is wa.Status.OK
    assert wa.torque_accuracy(found.result) == (np.inf,)
    nothing = wa.torque_schedule([0.0, 2.0], np.zeros((2, 2)))
    assert np.isnan(wa.torque_accuracy(wa.simulate(scene, nothing, traced=traced))).all()


@pytest.mark.parametrize("durations", [(1.0, 1.0), (2.0, 2.0), (8.0, 3.0)])
def test_an_object_with_time_to_spare_waits_before_a_slide_that_no_motor_could_follow(arrow, durations):
    """Moved for all of it, it needs torques right to 1e-5, or no numbers are as exact as the slide needs."""
    found = optimised_at(arrow, durations)
    assert found.result.status is wa.Status.OK
    assert min(found.bound_fraction) > 0.99
    assert min(wa.torque_accuracy(found.result)) >= FOLLOWABLE_ACCURACY
    for phase, duration in zip(found.result.phases, durations, strict=True):
        (wait,) = phase.holds
        assert wait.start == phase.start
        assert 0.4 * duration < wait.end - wait.start < duration
        assert wait.margin > 0
        assert not wait.may_move


def test_an_object_that_rubs_little_moves_faster_yet(arrow):
    """Its motion of 99.9 % of the largest margin needs torques right to 2e-5, also after a wait; that of 99 % less."""
    scene, _ = arrow
    slippery = eqx.tree_at(lambda s: s.object.friction, scene, np.full(3, 0.05))
    found = optimised_at((slippery, wa.trace(slippery)), (4.0, 4.0))
    assert found.result.status is wa.Status.OK
    assert min(found.bound_fraction) > 0.98
    assert min(wa.torque_accuracy(found.result)) >= FOLLOWABLE_ACCURACY


def test_a_slide_that_motors_can_follow_takes_all_its_time(arrow):
    found = optimised_at(arrow, (0.25, 0.25))
    assert not any(phase.holds for phase in found.result.phases)
    assert min(wa.torque_accuracy(found.result)) >= FOLLOWABLE_ACCURACY


def test_free_bodies_follow_the_slide_after_its_wait(arrow):
    """7.8 mm off where it moved all the time. What is left falls with the time step."""
    done = execute(optimised_at(arrow, (1.0, 1.0)).result, timestep=1e-4)
    assert done.ending.value == "ok"
    assert done.position_error < 2e-4
