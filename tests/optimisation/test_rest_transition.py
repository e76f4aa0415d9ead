"""Torques where one phase gives way to another at rest and torque rates are limited."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.dynamics import evaluate, locate_panel
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.model.scene import replace_duration
from wholearm_jax.optimisation.rest_transition import MIN_REST_MARGIN, Moving, ReachableTorque, Resting, rest_transition
from wholearm_jax.phases.phase_ends import statics_at_start

RATE = 2.0
MAX_DWELL = 0.25


def at_rest(dynamics, segment, s, torque):
    """Acceleration and contact forces at a place of a path at rest."""
    panel, xi = locate_panel(dynamics, segment, s)
    terms = jnp.stack([1.0, 0.0, 0.0, *torque])
    return float(evaluate(dynamics.acceleration, panel, xi) @ terms), np.asarray(
        evaluate(dynamics.force, panel, xi) @ terms
    )


@pytest.fixture(scope="module", params=["heptagon", "hexagon"])
def change(request):
    """A bundled plan's change of formation: the path that ends, the rest there, and the motion that follows."""
    scene = layered(request.param)
    traced = wa.trace(scene)
    first, second = (float(top.value) for top in wa.bounds(scene, traced=traced))
    before, onward = Moving(traced[0].dynamics, 1.0, first), Moving(traced[1].dynamics, 1.0, second)
    return before, Resting(*statics_at_start(scene, scene.phases[1], traced[1]), second), onward


def share_of(change, torque, begin):
    """The least margin over its bound with which two torques serve a change, -inf where they do not: by definition."""
    before, rest, onward = change
    dynamics, start = before.dynamics, onward.dynamics.breakpoints[0]
    braking, forces = at_rest(dynamics, dynamics.count - 1, dynamics.breakpoints[-1], torque)
    setting_out, next_forces = at_rest(onward.dynamics, 0, start, begin)
    one, limit = np.append(1.0, torque), rest.statics.torque_limit
    ahead, behind = ((row @ one) / np.linalg.norm(row[1:] * limit) for row in rest.accelerations)
    stays = ahead <= 1e-9 - MIN_REST_MARGIN and behind >= MIN_REST_MARGIN - 1e-9
    if not (stays and braking < 0 and abs(setting_out) < 1e-6):
        return -np.inf
    held = rest.statics.margin_under(torque).margin / rest.bound
    return min(forces.min() / before.bound, next_forces.min() / onward.bound, held)


def test_both_torques_serve_and_the_way_between_them_is_short_enough(change):
    before, rest, onward = change
    found = rest_transition(before, rest, onward, RATE, MAX_DWELL)
    assert 0.5 < found.margin_fraction <= 1
    assert share_of(change, found.torque, found.departure_torque) == pytest.approx(found.margin_fraction, rel=1e-6)
    assert 0 < found.dwell_time <= MAX_DWELL
    assert np.abs(found.departure_torque - found.torque).max() == pytest.approx(RATE * found.dwell_time, rel=1e-9)
    acceleration, _ = at_rest(onward.dynamics, 0, onward.dynamics.breakpoints[0], found.departure_torque)
    assert acceleration == pytest.approx(0.0, abs=1e-9)


def test_no_torques_nearby_or_far_serve_better(change):
    before, rest, onward = change
    found = rest_transition(before, rest, onward, RATE, MAX_DWELL)
    rng, limit, ahead = np.random.default_rng(1), rest.statics.torque_limit, rest.accelerations.ahead
    best, tried = -np.inf, 0
    for size in np.repeat([1e-3, 1e-2, 0.1, 0.5], 100):
        torque = np.clip(found.torque + size * rng.normal(size=2), -limit, limit)
        begin = found.departure_torque + size * rng.normal(size=2)
        begin -= ahead[1:] * (ahead @ np.append(1.0, begin)) / (ahead[1:] @ ahead[1:])
        if np.all(np.abs(begin) <= limit) and np.abs(begin - torque).max() <= RATE * MAX_DWELL:
            share = share_of(change, torque, begin)
            tried, best = tried + np.isfinite(share), max(best, share)
    assert tried > 10
    assert best <= found.margin_fraction / 0.99 + 1e-9, "the shortest way gives up a hundredth of the margin"


def test_a_torque_out_of_reach_is_none(change):
    before, rest, onward = change
    from_far = ReachableTorque(-rest.statics.torque_limit, 0.01)
    assert rest_transition(before, rest, onward, RATE, MAX_DWELL, from_far).margin_fraction == -np.inf
    free = rest_transition(before, rest, onward, RATE, MAX_DWELL)
    near = rest_transition(before, rest, onward, RATE, MAX_DWELL, ReachableTorque(free.torque, 0.01))
    assert np.abs(near.torque - free.torque).max() <= 0.01 + 1e-9


@pytest.mark.parametrize(
    ("name", "duration", "rate"),
    [
        ("heptagon", 1.0, 2.0),
        ("hexagon", 1.0, 2.0),
        pytest.param("tipping", 1.0, 10.0, marks=pytest.mark.slow),
        ("hexagon", 0.3, 20.0),  # where rounding has the object set out just before a knot, and no step fits in
    ],
)
def test_whole_plans_keep_a_limited_rate(name, duration, rate):
    scene = layered(name)
    phases = tuple(replace_duration(phase, duration) for phase in scene.phases)
    found = wa.optimise(eqx.tree_at(lambda s: s.phases, scene, phases), rate_limit=rate)
    assert found.result.status is wa.Status.OK, found.result.message
    assert min(found.bound_fraction) > 0.6
    times, values = np.asarray(found.torque.times), np.asarray(found.torque.values)
    steps, span = np.abs(np.diff(values, axis=0)).max(1), np.diff(times)
    assert np.all(steps <= rate * (1 + 1e-6) * span + 1e-12), "between knots as between phases"
    assert [float(p.duration) for p in found.scene.phases] == pytest.approx([duration, duration])


def test_an_object_that_is_held_between_phases_sets_out_at_a_limited_rate():
    data = to_dict(layered("heptagon"))
    slide, flip = data["phase"]
    pause = {"name": "pause", "contacts": slide["contacts"], "hold": True, "duration": 0.5}
    found = wa.optimise(wa.parse(data | {"phase": [slide, pause, flip]}), rate_limit=3.0)
    assert found.result.status is wa.Status.OK, found.result.message
    assert found.result.hold_margin > 0.5
    times, values = np.asarray(found.torque.times), np.asarray(found.torque.values)
    assert np.all(np.abs(np.diff(values, axis=0)).max(1) <= 3.0 * (1 + 1e-6) * np.diff(times) + 1e-12)


def test_where_no_torques_serve_the_reason_is_told():
    found = wa.optimise(layered("heptagon"), rate_limit=0.2)
    assert found.result.status is not wa.Status.OK
    assert found.result.phases[0].status is wa.Status.OK
    assert found.stopped[1] == "no torque lets this formation take over at the limited rate"


def test_a_rate_limit_is_positive():
    with pytest.raises(ValueError, match="rate_limit must be positive"):
        wa.optimise(layered("heptagon"), rate_limit=0.0)
