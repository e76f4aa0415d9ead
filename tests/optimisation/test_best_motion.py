"""The best of all motions of a plan's phases: an upper bound of what any schedule reaches, and consistent in itself."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from support import layered

import wholearm_jax as wa
from wholearm_jax.margin import rest_to_rest, solve_path
from wholearm_jax.model import Arrival, replace_duration
from wholearm_jax.tracing import Resolution


def lasting(scene, seconds):
    """The same plan with phases of another duration."""
    return eqx.tree_at(lambda s: s.phases, scene, tuple(replace_duration(p, seconds) for p in scene.phases))


@pytest.mark.parametrize("seconds", [1.0, 0.15])
@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
def test_no_schedule_reaches_more(name, seconds):
    scene = lasting(layered(name), seconds)
    traced = wa.trace(scene)
    best = wa.convex_bounds(scene, traced=traced)
    optimum = wa.optimise(scene, traced=traced)
    for phase, pointwise, convex in zip(optimum.result.phases, wa.bounds(scene, traced=traced), best, strict=True):
        assert phase.margin <= convex.margin * (1 + 1e-4)
        assert convex.margin <= float(pointwise.value) * (1 + 1e-4)
    assert optimum.result.phases[0].margin >= 0.98 * best[0].margin


def test_a_best_motion_is_consistent():
    """Its forces keep the margin, its torques are within limits, its times and speeds fit."""
    scene = lasting(layered("hexagon"), 0.15)
    for best, phase, path in zip(wa.convex_bounds(scene), scene.phases, wa.trace(scene), strict=True):
        assert best.feasible
        assert best.force.min() >= best.margin - 1e-6
        assert np.abs(best.torque).max() <= np.asarray(scene.hand.torque_limit).max() * (1 + 1e-6)
        assert best.time[-1] == pytest.approx(best.duration, rel=1e-6)
        assert best.duration <= float(phase.duration) * (1 + 1e-6)
        assert (best.speed[0], best.speed[-1]) == (0.0, 0.0)
        assert best.place[0] == 0.0
        assert best.place[-1] == pytest.approx(1.0)
        average = (best.speed[1:] + best.speed[:-1]) / 2
        assert np.sum(np.diff(best.place) * float(path.dynamics.length) / average) == pytest.approx(
            best.duration, rel=1e-6
        )
        assert sum(best.contact_weights.values()) == pytest.approx(1.0)


def test_more_time_is_worth_what_the_multiplier_says():
    scene = layered("hexagon")
    short, middle, long = (wa.convex_bounds(lasting(scene, t))[0] for t in (0.1499, 0.15, 0.1501))
    assert (long.margin - short.margin) / 0.0002 == pytest.approx(middle.time_gain, rel=1e-3)


def test_the_shortest_time_with_the_largest_margin_is_the_time_allowed():
    scene = lasting(layered("hexagon"), 0.15)
    best = wa.convex_bounds(scene)[0]
    fastest = wa.shortest_motions(scene, best.margin)[0]
    assert fastest.duration == pytest.approx(0.15, rel=1e-6)


def test_margins_that_no_motion_has_are_refused():
    scene = layered("heptagon")
    assert not any(best.feasible for best in wa.shortest_motions(scene, 5.0))
    assert not any(best.feasible for best in wa.convex_bounds(lasting(scene, 0.01)))


def test_a_phase_that_may_end_at_any_speed_has_at_least_the_margin():
    scene = lasting(layered("hexagon"), 0.15)
    caught = eqx.tree_at(
        lambda s: s.phases, scene, (replace(scene.phases[0], arrive=Arrival.ANY_SPEED), scene.phases[1])
    )
    assert wa.convex_bounds(caught)[0].margin > wa.convex_bounds(scene)[0].margin


def quantities(scene, intervals):
    """Return a function of the scene's floats in one vector, and that vector: largest margin and shortest time."""
    flat, join = ravel_pytree(eqx.filter(scene, eqx.is_inexact_array))
    rest = eqx.filter(scene, eqx.is_inexact_array, inverse=True)

    def optimum(numbers, fast):
        changed = eqx.combine(join(numbers), rest)
        path = wa.trace(changed, resolution=Resolution(segments=3, panels=8))[0]
        seconds, margin = jnp.where(fast, jnp.inf, changed.phases[0].duration), jnp.where(fast, 0.2, jnp.nan)
        best = solve_path(path.dynamics, seconds, margin, rest_to_rest(), intervals)
        return jnp.where(fast, best.duration, best.margin)

    return optimum, flat


@pytest.mark.parametrize("reverse", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_certificate_and_shortest_time_are_differentiable_in_every_float_of_a_scene(reverse):
    """Along a random direction. Differences trace the path anew and so place nodes a little elsewhere:
    they carry the derivative of the discretisation's error, which for the time is larger and falls with the intervals.
    """
    scene = lasting(layered("tipping"), 0.3)
    optimum, flat = quantities(eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1]), 480)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=flat.shape) * np.maximum(np.abs(flat), 0.01)
    slope = jax.jit(lambda fast: jax.jvp(lambda x: optimum(x, fast), (flat,), (direction,))[1])
    if reverse:
        slope = jax.jit(lambda fast: jax.grad(optimum)(flat, fast) @ direction)
    value = jax.jit(optimum)
    for fast, tolerance in ((False, 1e-5), (True, 3e-5)):
        difference = (value(flat + 1e-5 * direction, fast) - value(flat - 1e-5 * direction, fast)) / 2e-5
        assert float(slope(fast)) == pytest.approx(float(difference), rel=tolerance)


def test_without_weight_and_friction_of_joints_forces_scale_with_torques():
    """All torques times four move the object the same way in half the time, with four times the forces."""
    scene = wa.load("passage")
    none, hand = jnp.zeros(2), scene.hand
    scene = eqx.tree_at(lambda s: (s.gravity, s.hand.dry, s.hand.viscous), scene, (none, none, none))
    strong = eqx.tree_at(lambda s: s.hand.torque_limit, scene, 4 * hand.torque_limit)
    strong = eqx.tree_at(lambda s: [p.duration for p in s.phases], strong, [p.duration / 2 for p in scene.phases])
    for weak, four in zip(wa.convex_bounds(scene), wa.convex_bounds(strong), strict=True):
        assert weak.feasible
        assert weak.margin > 0
        assert four.margin == pytest.approx(4 * weak.margin, rel=1e-6)
