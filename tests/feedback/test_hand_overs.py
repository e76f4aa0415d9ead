"""Laws where a vertex and a fingertip take over from one another: nothing stops the object there."""

from pathlib import Path

import equinox as eqx
import mujoco
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.execution import IDEAL
from wholearm_jax.execution.acting_pairs import choose_pairs
from wholearm_jax.execution.executions import execute
from wholearm_jax.execution.mujoco_model import build_mujoco_model
from wholearm_jax.feedback import feedback
from wholearm_jax.feedback.either_formation import UNSURE
from wholearm_jax.feedback.path_table import path_terms, tabulate_path
from wholearm_jax.model import rigid_body
from wholearm_jax.phases import ends_at_stop
from wholearm_jax.phases.phase_ends import rest_terms

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def box():
    scene = wa.load("box")
    return wa.simulate(scene, wa.quasistatic(scene))


@pytest.fixture(scope="module")
def law(box):
    return feedback(box.scene, box.torque, friction=0.1)


def test_all_phases_but_the_first_end_at_a_stop(box, law):
    stops = [ends_at_stop(box.scene, phase, at.traced) for phase, at in zip(box.scene.phases, box.phases, strict=True)]
    assert stops == [False, True, True]
    assert [phase.reach > 0 for phase in law.phases] == stops
    assert law.margin > 0


def test_torques_at_a_hand_over_suit_both_formations(box, law):
    """Of the two torques there, neither accelerates the object much under the other formation, nor loses a contact."""
    paths = [phase.traced.dynamics for phase in box.phases[:2]]
    before, after = (path_terms(dynamics, tabulate_path(dynamics)) for dynamics in paths)
    for torque in (law.phases[0].torque[-1], law.phases[1].torque[0]):
        for terms, row in ((before, -1), (after, 0)):
            assert abs(terms.acceleration[row, 0] + terms.acceleration[row, 3:] @ torque) < 20.0
            assert (terms.slack[row, :, 0] + terms.slack[row, :, 3:] @ torque).min() > 0


def test_a_hand_without_noise_turns_the_box(box, law):
    done = execute(box, timestep=2e-4, controller=law, hardware=IDEAL)
    assert done.ending.value == "ok"
    assert done.position_error < 5e-4
    assert abs(done.angle_error) < 0.01
    assert len(done.events) >= 6
    for event in done.events:
        assert event.executed == pytest.approx(event.predicted, abs=0.1), event
    on_the_way = (done.expected.time > 1.3) & (done.expected.time < 1.9)
    column = done.names.index("finger2:e0")
    forces = done.force("finger2:e0", done.expected.time[on_the_way])
    np.testing.assert_allclose(forces, done.expected.cn[on_the_way, column], rtol=0.05)


def test_a_fingertip_meets_an_edge_from_its_outer_side_alone(box):
    """At the corner, a little inside the box, both edges would hold the tip, whose finger comes from one side."""
    bodies = build_mujoco_model(box.scene, 2e-4)
    data = mujoco.MjData(bodies.model)
    corner = np.asarray(box.phases[0].traced.end)

    def touching(deeper, filtered):
        data.qpos[:] = corner + np.array([0, 0, 0, 0, deeper])
        bodies.model.pair_margin[bodies.acting.edges.row] = bodies.acting.gap
        if filtered:
            choose_pairs(bodies.model, bodies.acting, data.qpos)
        mujoco.mj_step1(bodies.model, data)
        acting = data.contact.geom[data.contact.efc_address >= 0]
        return {bodies.names[bodies.pair[a, b]] for a, b in acting if bodies.pair[a, b] < len(bodies.names)}

    deeper = min((1e-6, -1e-6), key=lambda d: len({"finger2:e0", "finger2:e3"} - touching(d, filtered=False)))
    assert {"finger2:e0", "finger2:e3"} <= touching(deeper, filtered=False)
    assert "finger2:e0" in touching(deeper, filtered=True)
    assert "finger2:e3" not in touching(deeper, filtered=True)


@pytest.mark.parametrize(("beyond", "touches"), [(-1e-6, True), (1e-6, False)])
def test_a_vertex_meets_a_fingers_face_as_far_as_its_tip(box, beyond, touches):
    """Sunk in by more than its distance from the tip, where the end of a slab would push it away along the finger."""
    bodies = build_mujoco_model(box.scene, 2e-4)
    data = mujoco.MjData(bodies.model)
    begin = np.array(box.phases[2].traced.begin)  # vertex 1 at the tip of finger 2
    along = np.array([np.cos(begin[4]), np.sin(begin[4])])
    normal = np.array([along[1], -along[0]])  # into the object
    c, s = np.cos(begin[2]), np.sin(begin[2])
    vertex = np.array([[c, -s], [s, c]]) @ rigid_body(box.scene.object).vertices[1] + begin[:2]
    reached = (vertex - box.scene.hand.joint[1]) @ along - box.scene.hand.length[1]
    data.qpos[:] = begin
    data.qpos[:2] += (beyond - reached) * along - 5e-6 * normal
    choose_pairs(bodies.model, bodies.acting, data.qpos)
    mujoco.mj_step1(bodies.model, data)
    row = bodies.names.index("finger2:v1")
    found = [c for c in data.contact if bodies.pair[c.geom[0], c.geom[1]] == row and c.efc_address >= 0]
    assert len(found) == touches
    for contact in found:
        np.testing.assert_allclose(bodies.toward[row] * contact.frame[:2], normal, atol=1e-6)
        assert contact.dist == pytest.approx(-5e-6, rel=1e-2)


@pytest.fixture(scope="module")
def short_path():
    """A pentagon that a fingertip pushes by 3.5 mm to a vertex, and the finger, which takes over there, by 9 mm."""
    finger = {"length": 0.1383, "inertia": 1.08e-3, "viscous": 0.005, "dry": 0.01, "torque_limit": 5.0}
    finger["range"] = [0.3, 2.8]
    outline = [[-21.9, 47.2], [-41.0, -11.6], [-15.7, -38.0], [38.5, -41.3], [62.6, -13.2]]
    phases = [
        {"name": name, "contacts": ["palm:v0", "palm:v1", "finger1:v3", second], "toward": "x-", "duration": 1.0}
        for name, second in (("to the vertex", "finger2:e4"), ("beyond it", "finger2:v4"))
    ]
    phases[1]["until"] = {"x": -0.0125}
    scene = wa.parse(
        {
            "title": "a short path to a hand-over",
            "gravity": [-3.0, -9.0],
            "hand": {
                "fingers": "layered",
                "finger1": finger | {"joint": [0.1108, 0.0]},
                "finger2": finger | {"joint": [-0.1108, 0.0]},
            },
            "object": {
                "vertices": [[x / 1e3, y / 1e3] for x, y in outline],
                "mass": 0.2,
                "friction": {"palm": 0.3, "finger1": 0.05, "finger2": 0.1},
            },
            "start": {"x": 0.0, "y": 0.0418, "phi": 1.8845, "theta1": 2.3713, "theta2": 0.7706},
            "phase": phases,
        }
    )
    return wa.optimise(scene)


def of_other_friction(scene):
    return [eqx.tree_at(lambda s: s.object.friction, scene, k * scene.object.friction) for k in (0.9, 0.95, 1.05, 1.1)]


def test_a_law_that_lets_objects_stop_short_is_none(short_path):
    """Each contact is kept, but the object does not come to the hand-over, or runs beyond it."""
    slow = feedback(short_path.scene, short_path.torque, friction=0.1, stiffness=26.0, integral=4.3, observer=87.0)
    checked = wa.check(of_other_friction(short_path.scene), controller=slow)
    assert (checked.margin > 0).all()
    assert not (checked.status == wa.Status.OK).all()
    assert slow.margin == -np.inf


def test_a_motion_that_is_slow_at_a_hand_over_has_the_rates_of_a_faster_one(short_path):
    law = feedback(short_path.scene, short_path.torque, friction=0.1)
    assert law.margin > 0
    assert law.stiffness > 40
    checked = wa.check(of_other_friction(short_path.scene), controller=law)
    assert (checked.status == wa.Status.OK).all()
    done = execute(short_path.result, timestep=2e-4, controller=law)
    assert done.ending.value == "ok"
    assert done.position_error < 5e-4


def test_an_object_that_nothing_holds_waits_for_a_law_that_begins_without_acceleration():
    """Without friction the sign of rounding said that it moves backward, and no law was written."""
    scene = wa.load(DATA / "frictionless_slide.toml")
    schedule = wa.torque_schedule([0.0, 2.0], [[0.45, -0.45]] * 2)
    law = feedback(scene, schedule, friction=0.0)
    assert all(phase.margin > 3.0 for phase in law.phases)
    first = rest_terms(wa.trace(scene)[0].dynamics, 0)[0]
    assert abs(first.ahead @ np.append(1.0, law.phases[0].torque[0])) < 1e-9 * np.abs(first.ahead).max()
    done = execute(wa.simulate(scene, schedule), timestep=2e-4, controller=law)
    assert done.ending.value == "ok"
    assert done.position_error < 5e-4


def test_a_law_that_may_not_get_away_from_a_hand_over_is_refused():
    """The stop is so near that the feedback is small from the pivot's begin on: next to the hand-over it does not move
    the object as the contact holds it that the slide ends with. Executed, it stands still there."""
    scene = wa.load(DATA / "hand_over_near_stop.toml")
    optimum = wa.optimise(scene)
    assert optimum.result.status is wa.Status.OK
    law = feedback(scene, optimum.torque, friction=0.1, stiffness=60.0, integral=10.0, observer=200.0)
    slide, pivot = law.phases
    assert slide.margin > 0.4
    assert pivot.margin == -np.inf
    done = execute(optimum.result, timestep=5e-4, controller=law)
    assert done.ending.value == "astray"
    assert done.position_error > 1e-3
    # No farther than to where the stop's feedback begins is the gain that which moves it under either formation.
    assert pivot.reach == pytest.approx(pivot.s[-1] - UNSURE)
    before = path_terms(
        optimum.result.phases[0].traced.dynamics, tabulate_path(optimum.result.phases[0].traced.dynamics)
    )
    assert before.acceleration[-1, 3:] @ pivot.gain[0] > 0
