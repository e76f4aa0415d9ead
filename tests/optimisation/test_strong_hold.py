"""The torque with which an object waits: under it the object must stay, where there is such a torque."""

import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.margin import must_stay, rest_margin
from wholearm_jax.optimisation import strong_hold as module
from wholearm_jax.optimisation.strong_hold import strong_hold
from wholearm_jax.phases import find_hand_overs


@pytest.fixture(scope="module")
def box():
    """The bundled box, its paths, and the hand-over with which its second phase begins."""
    scene = wa.load("box")
    traced = wa.trace(scene)
    return scene, traced, find_hand_overs(scene, traced)[1]


def hold_of(box):
    scene, traced, hand_over = box
    return strong_hold(scene, scene.phases[1], traced[1], hand_over)


def test_of_those_that_hold_the_object_one_is_taken_under_which_it_must_stay(box):
    """Its best torque is not: there it may slide. What stays holds it with a smaller margin, by either contact."""
    _, _, hand_over = box
    best, hold = hand_over.best_hold(), hold_of(box)
    assert [must_stay(one.statics, best.torque[None]).all() for one in hand_over] != [True, True]
    assert hold.is_strong
    around = hold.static.torque + 0.005 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    for one in hand_over:
        assert must_stay(one.statics, around).all()
        assert hold.static.margin <= one.statics.margin_under(hold.static.torque).margin + 1e-9
        assert (one.accelerations.rest_rows() @ np.append(1.0, hold.static.torque) < 0).all()
    assert 1.0 < hold.static.margin < best.margin


def test_where_none_is_the_best_is_taken_and_what_may_move_is_said(box, monkeypatch):
    _, _, hand_over = box
    monkeypatch.setattr(module, "_farthest_from_others", lambda balances: None)
    hold = hold_of(box)
    assert not hold.is_strong
    np.testing.assert_allclose(hold.static.torque, hand_over.best_hold().torque)
    schedule = wa.torque_schedule([0.0, 1.0], [hold.static.torque] * 2)
    rests = [rest_margin(one.statics, schedule, 0.0, 1.0) for one in hand_over]
    assert any(rest.message.endswith("it may as well move, palm:v2 slides, finger1:v3 slides") for rest in rests)
