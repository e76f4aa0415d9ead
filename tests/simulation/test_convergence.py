"""The order of convergence is the method's, across torque knots and a slip reversal."""

from functools import cache
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.core.status import Status
from wholearm_jax.dynamics import placeholder_dynamics
from wholearm_jax.ensembles.ensemble import make_ensemble
from wholearm_jax.model.schedule import pad_schedule, restrict_to_phase
from wholearm_jax.simulation import IntegratorOptions, simulate_motion
from wholearm_jax.tracing.path import Resolution

LOOSE = 1e6  # a tolerance that accepts every step: steps are what lies between knots
KNOTS, TORQUE = np.linspace(0.0, 1.0, 5), np.array([[0.9, -0.2], [0.1, 0.5], [0.8, 0.3], [0.2, 0.9], [1.0, 0.1]])


@cache
def dynamics():
    """A path of length 1 with two smooth pieces; where they meet, at 0.6, the acceleration jumps as friction makes it.

    Each piece is one polynomial, so that nothing but steps, knots and the meeting can spoil the order.
    """
    powers = np.arange(8)[:, None]
    uneven = np.sin(1.0 + 2.0 * powers + 3.0 * np.arange(5)) * 0.8**powers
    segments = np.stack([uneven, -uneven])
    segments[0, 0] += [5.0, -0.6, -0.4, 1.5, -0.8]
    segments[1, 0] += [-2.0, 0.5, 0.3, 0.4, -0.2]
    empty = placeholder_dynamics(Resolution(segments=2, panels=2, nodes=8))
    given = ([0.0, 0.6, 1.0], 2, [0, 1], [1, 1], segments)
    return eqx.tree_at(
        lambda t: (t.breakpoints, t.count, t.first, t.panels, t.acceleration), empty, tuple(map(jnp.asarray, given))
    )


@cache
def program(solver):
    """A simulation of the phase in given steps, compiled for schedules of one padded length."""
    options = IntegratorOptions(solver=solver, tolerance=LOOSE, max_steps=320, max_stages=3)
    path, start, duration = dynamics(), jnp.zeros(()), jnp.ones(())
    return jax.jit(
        lambda schedule: simulate_motion(path, restrict_to_phase(schedule, start, duration), duration, options=options)
    )


def history(solver, parts):
    """`(s, w)` at every 32nd of the phase, then when the path's end is reached and at what speed; `parts` equal steps
    in each interval of the torque."""
    times = np.linspace(0.0, 1.0, 4 * parts + 1)
    values = np.stack([np.interp(times, KNOTS, column) for column in TORQUE.T], axis=1)
    found = program(solver)(pad_schedule(wa.torque_schedule(times, values), 320))
    count = int(found.count)
    assert int(found.status) == Status.LEFT_FORMATION
    assert set(np.asarray(found.segment)[:count].tolist()) == {0, 1}
    share, s, w = (np.asarray(a)[: count + 1] for a in (found.phase_time, found.s, found.w))
    common = np.abs(32 * share - np.round(32 * share)) < 1e-9
    return np.append(np.stack([s, w], axis=1)[common], [[share[-1], w[-1]]], axis=0)


@pytest.mark.parametrize(
    ("solver", "order", "parts"), [(dfx.Bosh3(), 3, (24, 64)), (dfx.Tsit5(), 5, (24, 64)), (dfx.Dopri8(), 8, (8, 24))]
)
def test_order_across_knots_and_a_slip_reversal(solver, order, parts):
    exact = history(dfx.Dopri8(), 72)
    coarse, fine = (np.abs(history(solver, n) - exact).max() for n in parts)
    observed = np.log(coarse / fine) / np.log(parts[1] / parts[0])
    print(f"{type(solver).__name__}: errors {coarse:.1e}, {fine:.1e}, observed order {observed:.2f}")
    assert observed > order - 0.5


def test_an_object_that_rests_within_a_step_is_stopped_and_set_out_again():
    """At 0.27 of the second phase it comes to rest for an eightieth, less than a step of most tolerances: the speed at
    steps' ends shows nothing, and carried on the object would slide back with the friction of forward travel."""
    varied = {"vertices": 0.0006, "friction": "60%", "mass": "20%"}
    scene = make_ensemble(layered("heptagon"), varied, seed=1).draw(1107)
    schedule = wa.read_torque(Path(__file__).parents[2] / "benchmarks" / "data" / "heptagon_knots.csv")
    traced = wa.trace(scene)
    margins = []
    for tolerance in (1e-5, 1e-7, 1e-9, 1e-12):
        phase = wa.simulate(scene, schedule, traced=traced, arrival=0.02, tolerance=tolerance).phases[1]
        motion = phase.outcome.motion
        rest = np.asarray(motion.at_rest)
        assert rest.sum() == 1
        assert np.diff(motion.phase_time)[rest] == pytest.approx(0.01254, abs=1e-4)
        assert (np.diff(motion.s) >= 0).all()
        margins.append(float(phase.margin))
    np.testing.assert_allclose(margins, margins[-1], rtol=0, atol=1e-7)
