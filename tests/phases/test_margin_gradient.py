"""The margin's gradient of numbers: from programs that every plan shares, and equal to the direct one."""

import equinox as eqx
import jax
import numpy as np
import pytest
from support import steadiest_difference

import wholearm_jax as wa
from wholearm_jax.phases import margin_gradient
from wholearm_jax.phases.compressive_margin import _margin_in_programs
from wholearm_jax.phases.plan_schedule import with_plan_step_capacity
from wholearm_jax.simulation import Adjoint
from wholearm_jax.tracing import Resolution

PROGRAMS = (margin_gradient._trace_along, margin_gradient._margin_along)


def compiled() -> list[int]:
    return [program.compiled_count() for program in PROGRAMS]


def inputs_of(scene):
    """A scene, and a schedule at which the margin has no kink."""
    even = wa.quasistatic(scene)
    return scene, wa.TorqueSchedule(1.01 * even.times, 0.99 * even.values)


@pytest.fixture(scope="module")
def slide():
    scene = wa.load("heptagon")
    return inputs_of(eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1]))


@pytest.fixture(scope="module")
def gradient(slide):
    return eqx.filter_value_and_grad(lambda inputs: wa.margin(*inputs))(slide)


def test_it_is_that_of_differences_along_any_direction(slide, gradient):
    value, slopes = gradient
    assert float(value) == pytest.approx(wa.simulate(*slide).margin, rel=1e-9)
    floats, rest = eqx.partition(slide, eqx.is_inexact_array)
    random = np.random.default_rng(2)
    way = jax.tree.map(lambda leaf: np.abs(leaf) * random.normal(size=leaf.shape), floats)
    options = wa.IntegratorOptions(tolerance=1e-12)

    def along(h):
        moved = jax.tree.map(lambda leaf, step: leaf + 0.01 * h * step, floats, way)
        return float(wa.margin(*eqx.combine(moved, rest), options=options))

    slope = sum(float((one * step).sum()) for one, step in zip(*map(jax.tree.leaves, (slopes, way)), strict=True))
    assert abs(slope) > 0.01
    assert 0.01 * slope == pytest.approx(steadiest_difference(along), rel=1e-6)


def test_other_scenes_and_choices_of_inputs_compile_nothing(slide, gradient):
    """Neither names, nor another object, nor what is differentiated give programs of their own."""
    before = compiled()
    scene, torque = slide
    slope = jax.grad(lambda friction: wa.margin(eqx.tree_at(lambda s: s.object.friction, scene, friction), torque))
    np.testing.assert_allclose(slope(scene.object.friction), gradient[1][0].object.friction, rtol=1e-12)
    other = wa.load("hexagon")
    other = inputs_of(eqx.tree_at(lambda s: s.phases, other, other.phases[:1]))
    assert bool(np.isfinite(eqx.filter_grad(wa.margin)(*other).object.mass))
    assert compiled() == before


def test_both_modes_give_the_same_slope(slide, gradient):
    scene, torque = slide
    _, slope = jax.jvp(
        lambda values: wa.margin(scene, wa.TorqueSchedule(torque.times, values)), [torque.values], [torque.values]
    )
    assert float(slope) == pytest.approx(float((gradient[1][1].values * torque.values).sum()), rel=1e-12)


@pytest.mark.slow
def test_it_is_the_direct_one(slide, gradient):
    """That of reverse mode through the tracing and the simulation, leaf by leaf."""
    scene, torque = slide
    options = wa.IntegratorOptions(adjoint=Adjoint.BOTH)
    options = with_plan_step_capacity(options, scene, torque)
    direct = eqx.filter_grad(lambda inputs: _margin_in_programs(*inputs, options=options, resolution=Resolution()))
    for ours, theirs in zip(*map(jax.tree.leaves, (gradient[1], direct(slide))), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * max(np.abs(theirs).max(), 1.0))
