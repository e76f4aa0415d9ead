"""The closed loop in the model: against an independent simulation, derivatives, statuses, batches."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import steadiest_difference

import wholearm_jax as wa
from tests.reference import unreduced
from tests.reference.closed_loop import ClosedLoop
from wholearm_jax.dynamics import tabulate_path_dynamics
from wholearm_jax.ensembles.ensemble import make_ensemble
from wholearm_jax.ensembles.scene_check import from_result
from wholearm_jax.feedback import law_tables
from wholearm_jax.files import controller_to_dict, scene_toml
from wholearm_jax.model import rigid_body, scaled_mechanics
from wholearm_jax.phases import (
    closed_loop_options,
    closed_loop_result,
    configuration,
    ends_at_contact,
    initial_loop_carry,
    loop_step,
    phase_inputs,
    simulate_closed_loop,
)
from wholearm_jax.simulation import IntegratorOptions, phase_loop
from wholearm_jax.simulation.closed_loop import memory_rate

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


def test_the_integral_part_goes_on_where_the_feedback_is_cut(thin, traced):
    """Its rate has no jump at the cut, where a motion could stay, and nothing winds up beyond it."""
    law = law_tables(thin)
    loop = phase_loop(law, jax.tree.map(lambda leaf: leaf[0], law.phases), traced[0].dynamics)
    middle = jnp.asarray(0.25)  # before the end presses
    row, k = jnp.searchsorted(loop.phase_time, middle, side="right") - 1, float(loop.integral)
    s_ref, v_ref = np.asarray(loop.reference[row] + loop.slope[row] * (middle - loop.phase_time[row]))[:2]
    s = s_ref - 1e-3

    def rate(i):
        memory = jnp.array([s, v_ref, i])
        return float(memory_rate(loop, traced[0].dynamics, 1.0, jnp.asarray(0), row, middle, jnp.asarray(s), memory)[2])

    gain = np.array([np.interp(s, loop.s, loop.gain[:, joint]) for joint in range(2)])
    most, pull = float(loop.push) / np.abs(gain).max(), float(loop.stiffness) ** 2 * 1e-3
    cut = most - pull
    assert rate(0.0) == pytest.approx(k * pull, rel=1e-9)  # nothing is cut: the error's integral
    assert rate(cut * (1 - 1e-9)) == pytest.approx(rate(cut * (1 + 1e-9)), rel=1e-6)
    assert rate(most) == pytest.approx(0.0, abs=1e-9 * k * most)
    assert rate(2 * most) == pytest.approx(-k * most, rel=1e-9)


@pytest.fixture(scope="module")
def first_phase(thin, rougher, traced):
    """The simulation of the first phase as a function of factors of friction, mass and feed-forward torques."""
    law = law_tables(replace(thin, phases=thin.phases[:1]))
    phase, path, body = rougher.phases[0], traced[0].path, rougher.object
    tables = jax.tree.map(lambda leaf: leaf[0], law.phases)

    def simulated(factors, adjoint):
        friction, mass, torque = factors
        scaled = eqx.tree_at(lambda b: (b.friction, b.mass), body, (body.friction * friction, body.mass * mass))
        mechanics = scaled_mechanics(rigid_body(scaled), rougher.hand, rougher.gravity, phase.formation)
        dynamics = tabulate_path_dynamics(mechanics, path)
        changed = replace(tables, torque=tables.torque * torque)
        options = closed_loop_options(IntegratorOptions(tolerance=1e-11, adjoint=adjoint))
        loop, at_contact = phase_loop(law, changed, dynamics), ends_at_contact(path)
        inputs = dynamics, loop, changed, at_contact, *phase_inputs(phase)
        return loop_step(law, options, 0.01, initial_loop_carry(law), inputs)[1]

    return simulated


@pytest.mark.slow
def test_derivatives_are_those_of_differences(first_phase):
    """Forward and reverse, with respect to friction, mass and torques, across a reversal; and in a batch."""
    simulated = first_phase
    here = jnp.ones(3)
    plain = jax.jit(lambda factors: simulated(factors, "none"))
    motion = plain(here).motion
    moves = ~np.asarray(motion.at_rest)[: int(motion.count)]
    assert (np.diff(moves.astype(int)) == 1).sum() == 1

    def least_force(factors, adjoint):
        return simulated(factors, adjoint).margin_result.margin

    several = jnp.stack([here, 1.001 * here])
    reverse = jax.jit(jax.vmap(jax.grad(lambda factors: least_force(factors, "reverse"))))(several)
    forward = jax.jit(jax.vmap(jax.jacfwd(lambda factors: least_force(factors, "forward"))))(several)
    assert np.abs(reverse / forward - 1).max() < 1e-9
    for k in range(3):
        difference = steadiest_difference(lambda h, k=k: float(plain(here.at[k].add(h)).margin_result.margin))
        assert float(forward[0, k]) == pytest.approx(difference, rel=1e-7)


def test_a_batch_is_what_each_scene_is_alone(thin, scene):
    ensemble = make_ensemble(scene, {"friction": "20%", "mass": "5%"}, seed=1)
    checked = wa.check(ensemble, controller=thin, count=2)
    alone = from_result(closed_loop_result(ensemble.draw(1), law_tables(thin)))
    assert wa.Status(int(checked.status[1])) is wa.Status.OK
    assert checked.status[1] == alone.status
    assert checked.margin[1] == pytest.approx(float(alone.margin), abs=1e-6)
    np.testing.assert_allclose(checked.end[1], alone.end, atol=1e-6)


def test_a_check_needs_a_schedule_or_a_controller_for_its_plan(thin, scene):
    other = wa.load("hexagon")
    with pytest.raises(ValueError, match="either a torque schedule or a controller"):
        wa.check([scene])
    with pytest.raises(ValueError, match="another plan"):
        wa.check([other], controller=thin)


def test_the_command_checks_a_controller(thin, scene, wholearm, tmp_path):
    path = tmp_path / "controller.json"
    wa.write_controller(thin, path)
    wa.save(scene, tmp_path / "plan.toml")
    options = ("--controller", path, "--vary", "friction=10%", "--count", "2")
    code, out, err = wholearm("check", tmp_path / "plan.toml", *options, "--out", tmp_path / "closed.zarr")
    assert code == 0, err
    assert "2 of 2 hold" in out
    assert "controller.json" in (tmp_path / "closed.json").read_text()
    code, _, err = wholearm("check", "hexagon", *options, "--out", tmp_path / "other.zarr")
    assert code == 2
    assert "another plan" in err
