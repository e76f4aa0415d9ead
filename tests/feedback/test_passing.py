"""Phases that follow one another without a stop, under a law."""

import equinox as eqx
import numpy as np
import pytest
from support import optimised

import wholearm_jax as wa
from wholearm_jax.core import Status
from wholearm_jax.ensembles import make_ensemble
from wholearm_jax.execution import ExecutionOutcome, Hardware, execute
from wholearm_jax.feedback import law_tables, least_passing_impulse
from wholearm_jax.feedback.path_table import tabulate_path
from wholearm_jax.feedback.stop_places import draw_shapes, has_paths, stop_places
from wholearm_jax.files.scene_toml import parse, to_dict
from wholearm_jax.model import uniform_schedule
from wholearm_jax.phases import closed_loop_result, describe_end

SHAPE = 5e-4  # of other parts' vertices [m]


@pytest.fixture(scope="module")
def flight():
    return optimised("flight")


@pytest.fixture(scope="module")
def passage():
    return optimised("passage")


def test_a_law_passes_from_phase_to_phase_in_time(passage):
    """The reference goes on beyond a path's end, as it came: an object a little behind it does not wait there."""
    optimum = passage
    law = wa.feedback(optimum.scene, optimum.torque)
    for phase in law.phases[:2]:
        assert phase.flows
        assert phase.reach > 0
        assert phase.approach == pytest.approx(phase.v_ref[-1])
    done = execute(optimum.result, controller=law, hardware=Hardware(), timestep=4e-4)
    assert done.ending is ExecutionOutcome.OK
    assert done.course.time[-1] < 1.2 * float(sum(phase.duration for phase in optimum.scene.phases)) + 0.1


def test_after_the_last_phase_there_is_nothing_to_go_on_to():
    table = to_dict(wa.load("passage"))
    table["phase"][-1]["arrive"] = "moving"
    scene = parse(table)
    law = wa.feedback(scene, wa.optimise(scene).torque, friction=0.0)
    assert [phase.flows for phase in law.phases] == [True, True, True]
    assert [phase.reach > 0 for phase in law.phases] == [True, True, False]


def test_the_last_phase_is_slow_where_other_parts_stop(passage):
    """Of parts that the design has not drawn, few stop before its reference is slow, or beyond where it ends."""
    scene = passage.scene
    law = wa.feedback(scene, passage.torque, friction=0.0, shape=SHAPE).phases[-1]
    slow = law.s_ref[np.argmax(law.v_ref <= law.approach * (1 + 1e-9))]  # from here on
    assert 0.5 * law.length < slow < law.length
    assert law.v_ref[-1] == pytest.approx(law.approach)
    tables = [tabulate_path(path.dynamics) for path in wa.trace(scene)]
    parts = [wa.trace(part) for part in draw_shapes([scene], SHAPE, seed=2, count=40)]
    places = np.array([stop_places(tables, [paths])[-1] for paths in parts if has_paths(paths)])
    assert len(places) > 36
    assert (places[:, 0] > law.length - slow).sum() <= 2
    assert (places[:, 1] > law.reach).sum() <= 2


def test_an_object_that_nothing_stops_is_not_pressed_on(passage):
    """The law presses at the last slide's end, where v6 meets finger1; with a shorter finger2 v3 slips off before."""
    scene = passage.scene
    law = law_tables(wa.feedback(scene, passage.torque, friction=0.0))
    slips_off = eqx.tree_at(lambda s: s.hand.length, scene, scene.hand.length - np.array([0.0, 1.5e-3]))
    for each, end, status in (
        (scene, "finger1:v6 is made", Status.OK),
        (slips_off, "finger2:v3 leaves its feature", Status.LEFT_FORMATION),
    ):
        last = closed_loop_result(each, law).phases[-1]
        assert describe_end(each, each.phases[-1], last.traced) == end
        assert last.status == status


def test_a_schedule_whose_motion_fails_gives_no_speeds_to_pass_with(passage):
    with pytest.raises(ValueError, match=r"without a stop.*has to succeed.*first slide: "):
        wa.feedback(passage.scene, wa.quasistatic(passage.scene))
    heptagon = wa.load("heptagon")
    idle = uniform_schedule(2.0, np.zeros((2, 2)))
    law = wa.feedback(heptagon, idle, friction=0.0, stiffness=40.0)  # the motion is the law's own
    assert (law.stiffness, law.integral, law.observer) == (40.0, 10.0, 200.0)
    with pytest.raises(ValueError, match=r"follow the schedule.s motion.*has to succeed"):
        wa.feedback(heptagon, idle, friction=0.0, own_motion=True)


def test_a_law_for_other_shapes_holds_objects_beside_the_reference(flight):
    """Torques that are best at a place alone may lose a contact a little before it, where starts are 1 mm off."""
    law = wa.feedback(flight.scene, flight.torque, mass=0.1, shape=SHAPE)
    ensemble = make_ensemble(flight.scene, {"start": 1e-3})
    margins = np.asarray(wa.check([ensemble.draw(k) for k in range(12)], controller=law).margin)
    assert (margins > 0).all()
    # Slips of parts of other shape reverse elsewhere: where the torque changes at once, theirs are not held yet.
    spreads = {"friction": "20%", "mass": "10%", "vertices": SHAPE, "start": 1e-3}
    others = make_ensemble(flight.scene, spreads, seed=2)
    margins = np.asarray(wa.check([others.draw(k) for k in range(12)], controller=law).margin)
    assert margins.min() > 0.97 * min(phase.margin for phase in law.phases)


def test_an_impulse_that_pulls_for_some_object_is_found(flight):
    """With less friction on finger 1 a contact of the third slide is pulled at, as the plan's own simulation has it."""
    scene = flight.scene
    assert least_passing_impulse(wa.load("heptagon"), 0.2) is None, "it stops between its phases"
    nominal = least_passing_impulse(scene, 0.0)
    assert nominal is not None
    assert nominal.share == pytest.approx(relative_impulses(flight.result)[nominal.phase].min(), rel=1e-6)
    found = least_passing_impulse(scene, 0.2)
    assert found is not None
    other = eqx.tree_at(lambda s: s.object.friction, scene, scene.object.friction * np.array([1.2, 0.8, 0.8]))
    result = wa.simulate(other, flight.torque)
    shares = relative_impulses(result)[2]
    assert found.share == pytest.approx(shares.min(), rel=0.03), "under this schedule it ends a little short"
    assert found.share < -0.01
    assert (found.phase, found.contact) == (2, scene.phases[2].formation.names[shares.argmin()])
    assert result.phases[2].opened == found.contact


def relative_impulses(result) -> list[np.ndarray]:
    """Impulses at the entry of each phase over the largest one."""
    return [np.array(phase.impulses) / max(*np.abs(phase.impulses), 1e-300) for phase in result.phases]
