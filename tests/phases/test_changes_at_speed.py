"""Changes of formation at speed: momentum, energy, what is refused, and derivatives through the change."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.dynamics import evaluate, locate_panel, resolve_impact
from wholearm_jax.model.kinematics import normal_jacobian, tangential_jacobian
from wholearm_jax.model.mechanics import scaled_mechanics
from wholearm_jax.model.scene import Arrival, rigid_body
from wholearm_jax.model.scene import path_target as wa_heading
from wholearm_jax.optimisation.optimiser import MIN_TRANSITION_SPEED
from wholearm_jax.phases import has_torque_jumps, simulate_phases
from wholearm_jax.phases.phase_ends import start_configuration
from wholearm_jax.simulation import Adjoint, IntegratorOptions

FLIGHTS = (pytest.param("flight", marks=pytest.mark.slow), "passage")


@pytest.fixture(scope="module", params=FLIGHTS)
def flown(request):
    return wa.optimise(layered(request.param), knots=31)


def test_three_formations_without_a_stop(flown):
    result = flown.result
    assert result.status is wa.Status.OK
    assert float(jnp.abs(flown.torque.values).max()) <= 1.0
    for before, after in zip(result.phases[:-1], result.phases[1:], strict=True):
        assert after.start == pytest.approx(before.time, abs=1e-12), "the change is when the formation ends"
        mean = float(after.traced.dynamics.length) / float(after.duration)
        assert float(after.outcome.impact.speed) > (MIN_TRANSITION_SPEED - 1e-6) * mean, "at speed"
        assert min(after.impulses) > 0
    times, values = np.asarray(flown.torque.times), np.asarray(flown.torque.values)
    assert np.abs(np.diff(values, axis=0)[np.diff(times) == 0]).max() < 1e-9, "a step there would be on a knife's edge"
    for phase, top in zip(result.phases, flown.bounds, strict=True):
        assert 0 < phase.margin <= float(top.value) + 1e-9


def test_changes_are_passed_as_fast_as_asked(flown):
    """Asking for more than was found raises the speed at the slower change, at some cost to the margin."""

    def slowest(found):
        last = found.result.phases[1:]
        return min(float(p.outcome.impact.speed) * float(p.duration) / float(p.traced.dynamics.length) for p in last)

    asked = 1.1 * slowest(flown)
    fast = wa.optimise(flown.scene, knots=31, passing=asked, traced=tuple(p.traced for p in flown.result.phases))
    assert slowest(fast) > asked * (1 - 1e-6)
    assert fast.result.status is wa.Status.OK
    assert 0.98 * flown.result.margin < fast.result.margin < flown.result.margin + 1e-3


def test_momentum_balances_and_energy_falls_across_every_change(flown):
    scene = flown.scene
    for before, after in zip(flown.result.phases[:-1], flown.result.phases[1:], strict=True):
        formation = scene.phases[flown.result.phases.index(after)].formation
        mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, formation)
        z_dot, dynamics = before.outcome.exit_velocity, after.traced.dynamics
        entered = resolve_impact(dynamics, z_dot)
        unit = mechanics.configuration_unit
        z = start_configuration(dynamics) / unit
        panel, xi = locate_panel(dynamics, jnp.asarray(0), dynamics.breakpoints[0])
        moving = evaluate(dynamics.velocity, panel, xi) * entered.speed / unit
        sliding = jnp.sign(tangential_jacobian(mechanics.contacts, z) @ moving)
        wrench = normal_jacobian(mechanics.contacts, z)
        wrench = wrench - (mechanics.contacts.friction * sliding)[:, None] * tangential_jacobian(mechanics.contacts, z)
        gained = mechanics.inertia * (moving - z_dot / unit)
        given = wrench.T @ (entered.impulse / mechanics.force_unit)
        scale = float(jnp.abs(mechanics.inertia * z_dot / unit).max())
        np.testing.assert_allclose(gained, given, atol=1e-12 * scale)
        energy = [float((mechanics.inertia * v**2).sum()) for v in (z_dot / unit, moving)]
        assert energy[1] <= energy[0] * (1 + 1e-12)
        assert float(jnp.abs(normal_jacobian(mechanics.contacts, z) @ moving).max()) < 1e-12 * float(
            jnp.abs(moving).max()
        )


def test_derivatives_pass_through_the_changes(flown):
    """The last phase's motion depends on torques before two changes, whose moments move with them."""
    scene, torque = flown.scene, flown.torque
    traced = wa.trace(scene)
    rng = np.random.default_rng(5)
    # More push at the beginning than planned, so that every formation ends at its own moment, before its time.
    ramp = jnp.asarray(np.linspace(1.02, 1.0, torque.values.shape[0]))[:, None]
    base = torque.values * ramp
    way = jnp.asarray(rng.normal(size=base.shape)) * 0.05

    def options(adjoint):  # a change that comes early leaves two rows of one time within the next phase
        return IntegratorOptions(
            tolerance=1e-13, max_steps=512, has_jumps=has_torque_jumps(scene, torque), adjoint=adjoint
        )

    def end(amount, adjoint=Adjoint.NONE):
        schedule = wa.TorqueSchedule(torque.times, base + amount * way)
        found = simulate_phases(scene, schedule, traced, options(adjoint))
        second = found[1]
        return jnp.stack([second.start, second.impact.speed, second.margin_result.margin, *second.impact.impulse])

    exact = jax.jvp(lambda a: end(a, "forward"), (0.0,), (1.0,))[1]
    assert abs(float(exact[0])) > 1e-3, "the moment of the change moves"
    weights = jnp.asarray(rng.normal(size=exact.shape))  # of all outputs at once, which compiles faster than of each
    reverse = jax.grad(lambda a: weights @ end(a, "both"))(0.0)

    def slope(h):
        return (end(h) - end(-h)) / (2 * h)

    richardson = (4 * slope(2.5e-4) - slope(5e-4)) / 3
    np.testing.assert_allclose(exact, richardson, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(weights @ exact, reverse, rtol=1e-9, atol=1e-12)


def test_a_change_that_would_throw_the_object_back_is_refused_by_name():
    scene = layered("heptagon")  # the slide goes left, the flip right: no impact turns one into the other
    flying = eqx.tree_at(lambda s: s.phases[0], scene, _flying(scene.phases[0]))
    found = wa.optimise(scene, knots=31)
    hasty = eqx.tree_at(lambda t: t.values, found.torque, found.torque.values.at[:31, 0].multiply(1.02))
    result = wa.simulate(flying, hasty)
    assert result.phases[0].status is wa.Status.OK
    assert result.phases[1].status in (wa.Status.REVERSED, wa.Status.CONTACT_LOST)
    assert result.phases[1].time == pytest.approx(result.phases[0].time)


def _flying(phase):
    return type(phase)(phase.name, phase.formation, phase.target, phase.duration, arrive=Arrival.MOVING)


@pytest.mark.parametrize("x", [0.0, -0.01, -0.015, -0.018])
def test_a_motion_cut_in_two_goes_on_as_it_was(x):
    """The second part is entered fast and its path is a fraction of a step: no overshoot, no impulse, the same end."""
    scene = layered("heptagon")
    slide = scene.phases[0]
    torque = wa.TorqueSchedule(jnp.array([0.0, 0.6, 1.2]), jnp.array([[0.55, -0.24], [0.55, -0.24], [0.55, -0.24]]))

    def pushed(*untils):
        headings = [slide.target if u is None else wa_heading("x-", {"x": u}) for u in untils]
        duration = jnp.asarray(1.2 / len(untils))
        parts = [type(slide)("slide", slide.formation, h, duration, arrive=Arrival.MOVING) for h in headings]
        return wa.simulate(eqx.tree_at(lambda s: s.phases, scene, tuple(parts)), torque)

    whole, cut = pushed(None), pushed(x, None)
    assert [p.status for p in cut.phases] == [whole.status, whole.status] == [wa.Status.OK] * 2
    assert cut.phases[1].time == pytest.approx(whole.phases[0].time, rel=1e-8)
    assert np.abs(cut.phases[1].impulses).max() < 1e-12
    np.testing.assert_allclose(cut.phases[1].outcome.exit_velocity, whole.phases[0].outcome.exit_velocity, rtol=1e-7)
