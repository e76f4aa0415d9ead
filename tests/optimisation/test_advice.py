"""Advice by cause: each failing phase names its own cause, and following the advice helps."""

import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.files import to_dict
from wholearm_jax.model import replace_duration
from wholearm_jax.optimisation import Search, advice, explain

CASES = Path(__file__).parents[1] / "data" / "cases"
KNOTS = 11


def with_duration(scene, number, duration):
    phases = tuple(replace_duration(p, duration) if k == number else p for k, p in enumerate(scene.phases))
    return eqx.tree_at(lambda s: s.phases, scene, phases)


@pytest.fixture(scope="module")
def heptagon():
    return wa.load("heptagon")


@pytest.fixture(scope="module")
def too_fast(heptagon):
    return wa.optimise(with_duration(heptagon, 0, 0.02), knots=KNOTS)


def test_too_little_time_is_named_with_a_duration_that_works(heptagon, too_fast):
    first, second = too_fast.result.phases
    assert "faster than the torques allow" in first.message
    assert "optimise" not in first.message
    assert "nan" not in first.message
    longer = float(re.search(r"--set 0\.duration=([\d.]+)", first.message)[1])
    assert 0.05 < longer < 0.2
    assert wa.optimise(with_duration(heptagon, 0, longer), knots=KNOTS).result.status is wa.Status.OK
    assert np.isfinite(np.asarray(too_fast.torque.values)).all()
    assert np.all(np.abs(too_fast.torque.values) <= np.asarray(heptagon.hand.torque_limit) * (1 + 1e-12))
    alone = wa.optimise(heptagon, knots=KNOTS).result.phases[1]
    assert second.status is wa.Status.OK, "a phase after one that fails is judged as if that had not"
    assert second.margin == pytest.approx(alone.margin, rel=1e-3)


def test_too_few_knots_are_named_with_a_number_that_works(heptagon):
    failed = next(p for p in wa.optimise(heptagon, knots=2).result.phases if p.status is not wa.Status.OK)
    assert "2 knots did not lead to it" in failed.message
    assert "duration" not in failed.remedy
    assert int(re.search(r"--knots (\d+)", failed.message)[1]) == KNOTS  # with which `too_fast` follows it: ok
    assert wa.optimise(heptagon, knots=KNOTS).result.status is wa.Status.OK


def test_a_phase_that_is_too_slow_to_depart_is_told_a_duration_that_works():
    """Nothing holds the object at the start, and a gentle start may lead either way: more knots do not help."""
    scene = wa.load(CASES.parent / "wedged_departure.toml")
    failed = wa.optimise(scene, knots=51, steps=40).result.phases[0]
    assert failed.status is wa.Status.AMBIGUOUS
    assert "so slowly no torques led to it" in failed.message
    assert "knots" not in failed.message
    advised = float(re.search(r"--set 0\.duration=([\d.]+)", failed.message)[1])
    assert advised < 0.5 * float(scene.phases[0].duration)
    assert wa.optimise(with_duration(scene, 0, advised), knots=51, steps=40).result.status is wa.Status.OK


def test_phases_without_a_stop_that_are_too_slow_are_told_durations_that_work():
    scene = wa.load("flight")
    for k, phase in enumerate(scene.phases):
        scene = with_duration(scene, k, 30 * float(phase.duration))
    slow = wa.optimise(scene).result
    said = [phase.message.partition("so slowly")[2] for phase in slow.phases if phase.status is not wa.Status.OK]
    (advised,) = {tuple(re.findall(r"--set (\d)\.duration=([\d.]+)", each)) for each in said}
    assert [int(k) for k, _ in advised] == [0, 1, 2]
    assert all('), or stop before the change of formation (`arrive = "rest"` in phase \'' in each for each in said)
    for k, seconds in advised:
        scene = with_duration(scene, int(k), float(seconds))
    assert wa.optimise(scene).result.status is wa.Status.OK


def test_where_an_impact_opens_a_contact_a_stop_before_it_is_advised(heptagon):
    """The impulses at the heptagon's flip pull: at no speed does the object pass; with the stop advised it is the
    bundled plan."""
    data = to_dict(heptagon)
    data["phase"][0]["arrive"] = "moving"
    slide, flip = wa.optimise(wa.parse(data), knots=KNOTS).result.phases
    assert slide.status is wa.Status.OK
    assert re.search(r"the impact at its beginning opens it .*; stop before the change of formation", flip.message)
    assert f"`arrive = \"rest\"` in phase '{slide.name}'" in flip.message
    assert "duration" not in flip.message
    data["phase"][0]["arrive"] = "rest"
    assert wa.optimise(wa.parse(data), knots=KNOTS).result.status is wa.Status.OK


def test_another_schedule_is_advised_to_be_optimised(heptagon):
    still = wa.simulate(heptagon, wa.torque_schedule([0.0, 2.0], [[0.0, 0.0], [0.0, 0.0]]))
    for phase in explain(still).phases:
        assert phase.remedy.endswith("`wholearm optimise` looks for torques that work")


STILL = (0, {"toward": "phi-"}, "phi, which `toward` names, stands still", "name one that moves: x, theta1, theta2")
WEDGED = (1, {}, "wedge the object", "lower the friction")


@pytest.mark.parametrize(("number", "change", "cause", "remedy"), [STILL, WEDGED], ids=["still", "wedged"])
def test_what_is_singular_is_said(number, change, cause, remedy, heptagon):
    data = to_dict(heptagon)
    data["phase"][number] |= change
    data["object"]["friction"] = 0.9
    result = wa.simulate(wa.parse(data), wa.torque_schedule([0.0, 2.0], [[0.1, -0.1], [0.1, -0.1]]))
    phase = explain(result).phases[number]
    assert phase.status is wa.Status.SINGULAR
    assert cause in phase.detail
    assert remedy in phase.remedy


def test_a_duration_beyond_numbers_is_too_short(heptagon):
    torque = wa.torque_schedule([0.0, 2.0], [[0.5, -0.4], [0.4, -0.3]])
    phase = explain(wa.simulate(with_duration(heptagon, 0, 1e-300), torque)).phases[0]
    assert "faster than the torques allow" in phase.detail
    assert "--set 0.duration=0.0" in phase.remedy


def test_where_the_bound_is_negative_no_more_time_is_advised():
    scene = wa.load(CASES / "box_rolling_start.toml")
    scene = eqx.tree_at(lambda s: s.hand.layered, scene, jnp.asarray(True))
    still = wa.simulate(scene, wa.torque_schedule([0.0, 10.0], [[0.1, -0.1], [0.1, -0.1]]))
    (phase,) = (p for p in explain(still).phases if p.status is not wa.Status.OK)
    assert "would have to pull" in phase.detail
    assert "duration" not in phase.message
    assert "optimise" not in phase.remedy


def test_before_an_obstacle_a_phase_may_end(heptagon):
    """Half-way through the slide finger 1's range ends: the advice is where to end the slide instead."""
    traced = wa.trace(heptagon)
    data = to_dict(heptagon)
    halfway = float((traced[0].begin[3] + traced[0].end[3]) / 2)
    data["hand"]["finger1"]["range"] = sorted(
        [halfway, float(traced[0].begin[3] + 0.1 * (traced[0].begin[3] - halfway))]
    )
    scene = wa.parse(data)
    result = wa.simulate(scene, wa.torque_schedule([0.0, 10.0], [[0.1, -0.1], [0.1, -0.1]]))
    coordinate, value = re.search(r"until = \{(\w+) = ([-\d.e]+)\}", result.phases[0].remedy).groups()
    assert bool(result.phases[0].traced.dynamics.ends_at_obstacle)
    data["phase"][0]["until"] = {coordinate: float(value)}
    before = wa.trace(wa.parse(data))[0]
    assert int(before.dynamics.status) == wa.Status.OK
    assert not bool(before.dynamics.ends_at_obstacle)


def test_a_refused_start_also_names_the_obstacle_further_on():
    scene = wa.load(CASES / "finger_below_palm.toml")
    result = wa.simulate(scene, wa.torque_schedule([0.0, 10.0], [[0.1, -0.1], [0.1, -0.1]]))
    message = result.phases[1].message
    assert message.count("finger2:e0 and finger2:e1 hold a tip at a vertex") == 1
    assert "finger2:e0 and finger2:e0" not in message
    assert "further on finger1 reaches its range at 0 deg, level with the palm" in message


def test_each_cause_has_its_own_words(too_fast):
    """Torque limits, rates, and a phase that is hardly longer than the fastest motion."""
    phase = replace(too_fast.result.phases[0], duration=1.0)
    search = Search(KNOTS)
    detail, remedy = advice._explain_motion(0, phase, np.inf, search)
    assert "however long" in detail
    assert "torque limits" in remedy
    assert "--set 2.duration=1.4" in advice._explain_motion(2, phase, 0.9, search)[1]
    assert "`arrive = \"rest\"` in phase 'a'" in advice._explain_motion(1, phase, 0.1, search, "a")[1]
    stiff = replace(phase, status=wa.Status.MAX_STEPS)
    assert advice._explain_motion(0, stiff, 0.1, search)[1] is None
    assert "--rate-limit" in advice._explain_motion(0, phase, 0.1, Search(KNOTS, limits_rates=True))[1]
    for value, rounded in ((0.0931, 0.094), (0.93, 0.93), (1.01, 1.1), (123.0, 130.0)):
        assert advice.round_up_digits(value) == pytest.approx(rounded, rel=1e-12)
