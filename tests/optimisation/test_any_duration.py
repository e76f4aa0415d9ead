"""Optimised plans of any duration: from the shortest possible to much longer ones, and the shortest with a margin."""

import equinox as eqx
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.core import as_device_array
from wholearm_jax.margin import PROGRAMME_INTERVALS, largest_margin, rest_to_rest
from wholearm_jax.model import path_target, replace_duration
from wholearm_jax.phases import trace

LENGTHENED = (1.1, 1.5, 2.5, 6.0, 20.0, 100.0)  # durations over the shortest possible ones


def with_durations(scene, durations):
    phases = tuple(replace_duration(phase, time) for phase, time in zip(scene.phases, durations, strict=True))
    return eqx.tree_at(lambda s: s.phases, scene, phases)


@pytest.fixture(scope="module", params=["heptagon", "hexagon"])
def plan(request):
    """A plan of one phase, its path, and the shortest duration that any torque allows."""
    scene = layered(request.param)
    scene = eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1])
    traced = trace(scene)
    (fastest,) = wa.shortest_motions(scene, 0.0, traced=traced)
    return scene, traced, fastest.duration


def test_every_duration_has_a_plan_and_more_time_costs_no_margin(plan):
    """The certificate of each is never exceeded, and the schedule lasts as long as it should."""
    scene, traced, shortest = plan
    margins = []
    for factor in LENGTHENED:
        found = wa.optimise(with_durations(scene, [factor * shortest]), traced=traced)
        assert found.result.status is wa.Status.OK, (factor, found.result.message)
        assert float(found.torque.times[-1]) == pytest.approx(factor * shortest)
        assert 0.9 < found.bound_fraction[0] <= 1 + 1e-6
        assert all(rest.margin >= found.result.margin for rest in found.result.phases[0].holds)
        margins.append(found.result.margin)
    best_before = np.maximum.accumulate(margins)
    assert np.all(margins >= best_before * (1 - 1e-3)), margins


def test_too_short_is_told_before_any_iteration(plan):
    scene, traced, shortest = plan
    found = wa.optimise(with_durations(scene, [0.97 * shortest]), traced=traced)
    assert found.result.status is wa.Status.TOO_SHORT
    assert not found.history
    assert f"the phase takes {shortest:.4g} s or longer" in found.result.message


def test_the_shortest_plan_keeps_its_margin(plan):
    scene, traced, _ = plan
    (best,) = wa.convex_bounds(scene, any_duration=True, traced=traced)
    wanted = 0.8 * best.margin
    (fastest,) = wa.shortest_motions(scene, wanted, traced=traced)
    found = wa.optimise(scene, margin=wanted, traced=traced)
    assert found.result.status is wa.Status.OK
    assert found.result.margin >= wanted
    assert fastest.duration <= float(found.scene.phases[0].duration) <= 1.1 * fastest.duration
    with pytest.raises(ValueError, match=rf"slide left.*at most {best.margin:.4g} N"):
        wa.optimise(scene, margin=1.01 * best.margin, traced=traced)


def test_more_intervals_lower_the_bound_by_little(plan):
    """What discretisation adds is on the safe side, and small."""
    _, traced, shortest = plan
    duration = as_device_array(2 * shortest)
    coarse, fine = (
        float(largest_margin(traced[0].dynamics, duration, rest_to_rest(), 0, n).margin)
        for n in (PROGRAMME_INTERVALS // 2, PROGRAMME_INTERVALS)
    )
    assert fine * (1 - 1e-6) <= coarse < fine * (1 + 2e-3)


def test_the_bound_covers_motions_that_are_fast_after_a_wait():
    """A flip that ends early waits, and then moves faster than eight path lengths a duration: beyond `wa.bounds`."""
    scene = wa.load("heptagon")
    target = path_target("phi-", {"phi": 0.81866})
    scene = eqx.tree_at(lambda s: s.phases[1].target, scene, target)
    found = wa.optimise(scene)
    assert found.result.status is wa.Status.OK
    assert found.result.phases[1].margin > float(wa.bounds(scene)[1].value)
    for phase, bound in zip(found.result.phases, found.bounds, strict=True):
        assert 0.999 * float(bound.value) < phase.margin <= float(bound.value)
