"""Phases that follow one another without a stop, under a law."""

import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.ensembles import make_ensemble
from wholearm_jax.execution import ExecutionOutcome, Hardware, execute


@pytest.fixture(scope="module")
def flight():
    return wa.optimise(wa.load("flight"))


@pytest.mark.slow
def test_a_law_passes_from_phase_to_phase_in_time():
    """The reference goes on beyond a path's end, as it came: an object a little behind it does not wait there."""
    optimum = wa.optimise(wa.load("passage"))
    law = wa.feedback(optimum.scene, optimum.torque)
    for phase in law.phases[:2]:
        assert phase.flows
        assert phase.reach > 0
        assert phase.approach == pytest.approx(phase.v_ref[-1])
    done = execute(optimum.result, controller=law, hardware=Hardware())
    assert done.ending is ExecutionOutcome.OK
    assert done.course.time[-1] < 1.2 * float(sum(phase.duration for phase in optimum.scene.phases)) + 0.1


@pytest.mark.slow
def test_a_law_for_other_shapes_holds_objects_beside_the_reference(flight):
    """Torques that are best at a place alone may lose a contact a little before it, where starts are 1 mm off."""
    law = wa.feedback(flight.scene, flight.torque, mass=0.1, shape=5e-4)
    ensemble = make_ensemble(flight.scene, {"start": 1e-3})
    margins = np.asarray(wa.check([ensemble.draw(k) for k in range(12)], controller=law).margin)
    assert (margins > 0).all()
