"""The self-check of derivatives that users run on their own scenes."""

import math

import equinox as eqx
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.phases.gradients import DirectionalDerivative, _most_stable, check_gradient


@pytest.fixture(scope="module")
def slide():
    scene = layered("heptagon")
    scene = eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1])
    return scene, wa.quasistatic(scene)


@pytest.mark.slow
def test_all_inputs_of_a_bundled_phase(slide):
    scene, even = slide
    torque = wa.TorqueSchedule(1.01 * even.times, 0.99 * even.values)
    slopes = check_gradient(scene, torque, tolerances=(1e-10,))
    assert [s.group for s in slopes] == ["torques", "object", "hand", "gravity", "start"]
    assert [s.finding for s in slopes] == ["agree"] * 5
    assert sum(abs(s.forward) > 1e-3 for s in slopes) >= 4, "slopes that are not zero"


@pytest.mark.parametrize(
    ("forward", "reverse", "differences", "uncertainty", "finding"),
    [
        (1.0, 1.0, 1.0 + 1e-7, 1e-8, "agree"),
        (1.0, -1.0, 1.0, 1e-8, "differ"),
        (-1.0, -1.0, 1.0, 1e-8, "differ"),
        (1.0, 1.0, 1.01, 1e-4, "differ"),
        (1.0, 1.0, 1.5, 0.3, "unsure"),
        (1.0, math.nan, 1.0, 1e-8, "differ"),
        (math.nan, math.nan, 1.0, 1e-8, "differ"),
        (1.0, 1.0, math.nan, 1e-8, "differ"),
        (1e-17, 0.0, 1e-11, 1e-12, "agree"),
    ],
)
def test_findings(forward, reverse, differences, uncertainty, finding):
    assert DirectionalDerivative("torques", 1e-10, forward, reverse, differences, uncertainty).finding == finding


def test_a_plan_without_a_margin_has_no_slopes(slide):
    scene, even = slide
    with pytest.raises(ValueError, match="no margin"):
        check_gradient(scene, wa.TorqueSchedule(even.times, 0 * even.values))


def test_a_step_without_a_margin_tells_nothing():
    assert _most_stable([math.nan, 1.0, 1.1, 1.1001]) == (pytest.approx(1e-4), 1.1001)
    change, best = _most_stable([math.nan, 1.0, math.inf])
    assert DirectionalDerivative("hand", 1e-8, 1.0, 1.0, best, change).finding == "unsure"
