"""The closed loop in the model: against an independent simulation, derivatives, statuses, batches."""

from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest

import wholearm_jax as wa
from tests.reference import unreduced
from tests.reference.closed_loop import ClosedLoop
from wholearm_jax.feedback import law_tables
from wholearm_jax.files import controller_to_dict, scene_toml
from wholearm_jax.phases import configuration, simulate_closed_loop
from wholearm_jax.simulation import IntegratorOptions

FRICTION = np.array([1.1, 0.95, 1.15])  # of each link, over the scene's


@pytest.fixture(scope="module")
def thin(controller):
    """The controller with fewer rows: what the model makes of a law does not depend on their number."""

    def thinned(phase):
        nodes = np.unique(np.append(np.arange(0, len(phase.s), 8), len(phase.s) - 1))
        times = np.unique(np.append(np.arange(0, len(phase.time), 4), len(phase.time) - 1))
        along = {name: getattr(phase, name)[nodes] for name in ("s", "theta", "tangent", "gain")}
        over_time = {name: getattr(phase, name)[times] for name in ("time", "s_ref", "v_ref", "torque")}
        return replace(phase, **along, **over_time)

    return replace(controller, phases=tuple(thinned(phase) for phase in controller.phases))


@pytest.fixture(scope="module")
def rougher(scene):
    return eqx.tree_at(lambda s: s.object.friction, scene, scene.object.friction * FRICTION)


@pytest.fixture(scope="module")
def traced(rougher):
    return wa.trace(rougher)


def test_the_motion_is_that_of_all_five_coordinates(thin, rougher, traced):
    """Departure, motion, memory and least force of a phase with a reversal, against Newton and Euler and the page."""
    first, _ = simulate_closed_loop(rougher, law_tables(thin), traced, IntegratorOptions(tolerance=1e-9))
    motion, count, duration = first.motion, int(first.motion.count), float(first.duration)
    times = duration * np.asarray(motion.phase_time)[: count + 1]
    rest = int(np.asarray(motion.at_rest)[:count].sum())
    lowest = duration * float(first.margin_result.phase_time)
    picked = rest + (count - rest) * np.arange(1, 8) // 8

    data = scene_toml.to_dict(rougher)
    model, begin = unreduced.Model(data, data["phase"][0]["contacts"]), np.asarray(traced[0].begin)
    tangent = model.direction(begin, data["phase"][0]["toward"])
    loop = ClosedLoop(controller_to_dict(thin), 0, model, np.sign(model.reversing(begin, tangent)))
    asked = np.unique(np.append(times[picked], lowest))
    departure, states = loop.follow(begin, tangent, asked, rtol=1e-8)
    assert loop.reversals == 1
    assert 0 < departure < times[-1]
    assert times[rest] == pytest.approx(departure, abs=1e-9)
    for k in picked:
        y, _ = states[np.searchsorted(asked, times[k])]
        z = configuration(traced[0].dynamics, motion.segment[k - 1], motion.s[k])
        assert np.abs(np.asarray(z) - y[:5]).max() < 1e-8
        assert np.abs(np.asarray(motion.memory[k]) - y[10:]).max() < 1e-5
    _, force = states[np.searchsorted(asked, lowest)]
    assert float(first.margin_result.margin) == pytest.approx(force, abs=1e-6)
    assert float(first.margin_result.margin) <= min(least for _, least in states) + 1e-6
