"""Limits of torques at hand-overs: where they stand among an interval's inputs, and what they leave of a margin."""

from pathlib import Path

import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.core import Status
from wholearm_jax.optimisation.hand_over_limits import EARLY_OR_LATE, hand_over_row_count, hand_over_rows
from wholearm_jax.phases import STARTING, STOPPING, HandOver, find_hand_overs, one_sided_torques

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def braked():
    """The torques with the largest margin along the path would brake the box by the contact that ends alone."""
    scene = wa.load(DATA / "hand_over_braked.toml")
    traced = wa.trace(scene)
    return scene, traced, find_hand_overs(scene, traced)[1]


@pytest.mark.parametrize("knots", [2, 3, 51, 201])
def test_rows_hold_where_torques_serve_at_all_times_near_the_hand_over(braked, monkeypatch, knots):
    """The least row of a phase is that of the torque, interpolated between knots, at the worst of many times."""
    scene, _, over = braked
    rng = np.random.default_rng(3)
    rows = {sign: rng.normal(size=(5, 3)) for sign in (STARTING, STOPPING)}
    monkeypatch.setattr(HandOver, "unplanned_rows", lambda _, sign: rows[sign])
    placed = hand_over_rows(over, over, 2, knots - 1, hand_over_row_count(scene, knots))
    times, torque = np.linspace(0.0, 1.0, knots), rng.normal(size=(2, knots, 2))
    inputs = np.concatenate([np.ones((2, knots - 1, 1)), torque[:, :-1], torque[:, 1:]], axis=2)
    values = np.einsum("pkrq,pkq->pkr", placed, inputs)
    least = np.where(np.any(placed != 0, 3), values, np.inf).min((1, 2))

    near = np.linspace(0.0, EARLY_OR_LATE, 501)  # with all knots
    for phase, sign, moments in ((0, STARTING, near), (1, STOPPING, 1 - near)):
        at = np.stack([np.ones(near.size), *(np.interp(moments, times, column) for column in torque[phase].T)])
        np.testing.assert_allclose(least[phase], (rows[sign] @ at).min(), atol=1e-12)


def test_plans_without_hand_overs_have_no_rows():
    assert hand_over_row_count(wa.load("heptagon"), 51) == 0


def test_what_a_hand_over_leaves_is_reached_and_said(braked):
    scene, traced, over = braked
    left = over.planned_margin(STOPPING)
    assert 0 < left < 0.5 * wa.convex_bounds(scene, traced=traced)[0].margin
    optimum = wa.optimise(scene, traced=traced)
    assert optimum.result.status is Status.OK, optimum.result.message
    assert 0.99 * left < optimum.result.phases[0].margin < 1.001 * left
    assert f"{left:.4g} N, the most with which torques serve by either contact of its hand-over" in optimum.stopped[0]
    assert optimum.stopped[1] == "within 0.001 of the bound"
    assert optimum.bound_fraction[1] > 0.99
    assert one_sided_torques(optimum.result) == ()


def test_a_margin_beyond_what_a_hand_over_leaves_is_refused_by_its_number(braked):
    scene, traced, over = braked
    reached = f"torques that serve by either contact of its hand-over reach {over.planned_margin(STOPPING):.4g} N"
    with pytest.raises(ValueError, match=f"no motion of phase 'vertex' has a margin of 0.4 N: {reached}"):
        wa.optimise(scene, margin=0.4, traced=traced)
