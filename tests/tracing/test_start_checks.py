"""Starts that are refused: a fingertip that two contacts hold at a corner slips off it."""

import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.files.scene_toml import parse
from wholearm_jax.model import contact_formation, contact_kinematics, contact_set, rigid_body
from wholearm_jax.planning import successor_formations, touching_contacts
from wholearm_jax.tracing import hold_same_tip

ANGLE = {"finger1": 2.0, "finger2": 1.1}


def scene_of(vertices, length=0.11, then=("palm:v0", "finger1:v2", "finger1:e1", "finger2:e3")):
    finger = {"length": length, "inertia": 2e-3, "viscous": 0.02, "dry": 0.01, "torque_limit": 1.0}
    return parse(
        {
            "title": "a tip at a corner",
            "gravity": 9.81,
            "hand": {"finger1": {"joint": [0.12, 0.0]} | finger, "finger2": {"joint": [-0.12, 0.0]} | finger},
            "object": {"vertices": vertices, "mass": 0.2, "friction": {"palm": 0.5, "finger1": 0.1, "finger2": 0.1}},
            "start": {"on": "e0", "x": 0.0},
            "phase": [
                {
                    "name": "one",
                    "contacts": ["palm:v0", "palm:v1", "finger1:e1", "finger2:e3"],
                    "toward": "x+",
                    "duration": 1.0,
                },
                {
                    "name": "two",
                    "contacts": list(then),
                    "toward": "theta2-",
                    "duration": 1.0,
                },
            ],
        }
    )


BOX = [[-0.02, -0.03], [0.02, -0.03], [0.02, 0.03], [-0.02, 0.03]]
L_SHAPE = [[0.0, 0.0], [0.06, 0.0], [0.06, 0.02], [0.02, 0.02], [0.02, 0.06], [0.0, 0.06]]
NOTCH = 3


def held_twice(scene, contacts, finger, vertex, phi):
    """The check's answer with the tip of a finger at a vertex."""
    body, hand, k = rigid_body(scene.object), scene.hand, int(finger[-1]) - 1
    angles = np.array([ANGLE["finger1"], ANGLE["finger2"]])
    tip = np.asarray(hand.joint)[k] + float(hand.length[k]) * np.array([np.cos(angles[k]), np.sin(angles[k])])
    turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    place = tip - turn @ np.asarray(body.vertices)[vertex]
    z = jnp.asarray([*place, phi, *angles])
    held = contact_set(body, hand, contact_formation(contacts))
    at = contact_kinematics(held, z)
    return np.asarray(hold_same_tip(held, at, held, at))


@pytest.mark.parametrize("finger", ["finger1", "finger2"])
@pytest.mark.parametrize("vertex", range(6))
def test_two_edges_hold_a_tip_only_in_a_notch(finger, vertex):
    before = (vertex - 1) % 6
    contacts = [f"{finger}:e{before}", f"{finger}:e{vertex}", "palm:v0", "palm:v1"]
    twice = held_twice(scene_of(L_SHAPE), contacts, finger, vertex, 0.3)
    expected = np.zeros((4, 4), bool)
    expected[[0, 1], [1, 0]] = vertex != NOTCH
    assert (twice == expected).all()


@pytest.mark.parametrize("finger", ["finger1", "finger2"])
def test_an_edge_and_its_end_hold_a_tip_nowhere(finger):
    scene, contacts = scene_of(BOX), [f"{finger}:e1", f"{finger}:v2", "palm:v0", "palm:v1"]
    assert held_twice(scene, contacts, finger, 2, 0.3)[0, 1]
    assert not held_twice(scene, contacts, finger, 0, 0.3).any()  # the tip elsewhere


def test_a_rolling_contact_holds_its_point_once():
    contacts = ["finger1:e1 rolling", "palm:v0", "finger2:e3"]
    assert not held_twice(scene_of(BOX), contacts, "finger1", 2, 0.3).any()


def test_a_plan_that_goes_on_with_a_tip_at_a_corner_is_refused_by_name():
    """The first phase ends where the tip has come to the corner; the second would keep it there."""
    scene = scene_of(BOX)
    result = wa.simulate(scene, wa.quasistatic(scene))
    second = result.phases[1]
    assert second.status is wa.Status.LEFT_FORMATION
    assert "finger1:v2 and finger1:e1 hold a tip at a vertex" in result.message or "finger1:v2 and" in second.detail


@pytest.mark.parametrize("contact", ["finger1:v2", "finger1:e1"])
def test_a_plan_that_turns_an_object_on_the_very_tip_of_a_finger_is_refused_by_name(contact):
    scene = scene_of(BOX, then=("palm:v0", f"{contact} rolling", "finger2:e3"))
    second = wa.simulate(scene, wa.quasistatic(scene)).phases[1]
    assert second.status is wa.Status.LEFT_FORMATION
    assert f"{contact} rolling at the end of its feature, where it slips off" in second.detail


@pytest.fixture(scope="module")
def ways_on():
    """Formations that come next, by their contacts on the first finger, where its tip has come to the corner."""
    scene = scene_of(BOX)
    end = wa.trace(scene)[0].end
    touching = touching_contacts(scene, end)
    assert {"finger1:e1", "finger1:v2", "finger1:e2"} <= {*touching}
    return successor_formations(scene, end)


def finger1_holds(successor):
    return tuple(name for name in successor.contacts if name.startswith("finger1"))


def test_no_tip_at_a_corner_is_offered_to_plans(ways_on):
    assert ways_on
    assert all(len(finger1_holds(successor)) == 1 for successor in ways_on)


def test_the_vertex_takes_over_where_a_tip_slides_off_an_edge(ways_on):
    """The box slides on under the finger, until the other finger's tip has come down to the palm."""
    (onward,) = [way for way in ways_on if finger1_holds(way) == ("finger1:v2",)]
    assert float(onward.end[0]) == pytest.approx(-0.12 + 0.11 + 0.02, abs=1e-9)


def test_the_tip_slides_back_from_the_corner(ways_on):
    (back,) = [way for way in ways_on if finger1_holds(way) == ("finger1:e1",) and way.status is wa.Status.OK]
    assert float(back.end[0]) == pytest.approx(-0.12 + np.sqrt(0.11**2 - 0.06**2) + 0.02, abs=1e-9)


def test_a_finger_that_would_cut_the_corner_off_is_refused(ways_on):
    """From the right side of the box, the tip cannot go on along its top."""
    beyond = [way for way in ways_on if finger1_holds(way) == ("finger1:e2",)]
    assert beyond
    assert all(way.status is wa.Status.LEFT_FORMATION for way in beyond)
