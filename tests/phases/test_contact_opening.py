"""A contact that an impact would have to pull at opens: how far, against five free coordinates without it.

The oracle (`reference/unreduced`) lets the contact go, holds the other three, and waits until its gap closes again.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from reference.unreduced import Model
from scipy.integrate import solve_ivp
from support import optimised

import wholearm_jax as wa
from wholearm_jax.dynamics import evaluate, locate_panel, resolve_impact
from wholearm_jax.feedback import law_tables
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.phases import IMPULSE_ROUNDING, MAX_OPENING, closed_loop_result, contact_opening
from wholearm_jax.phases.phase_ends import start_configuration

TORQUES = np.linspace(-0.9, 0.9, 19)


@pytest.fixture(scope="module")
def entry():
    """The bundled `flight` with a friction at which the impulse of its third slide's entry pulls at one contact."""
    scene = wa.load("flight")
    scene = eqx.tree_at(lambda s: s.object.friction, scene, scene.object.friction * jnp.array([1.2, 0.8, 0.8]))
    before, after = (one.dynamics for one in wa.trace(scene)[1:3])
    panel, xi = locate_panel(before, before.count - 1, before.breakpoints[before.count])
    direction = np.asarray(evaluate(before.velocity, panel, xi))
    return scene, after, direction / np.hypot(*direction[:2])


def entry_force(dynamics, speed, torque):
    """Forces at the path's start, from the table."""
    panel, xi = locate_panel(dynamics, jnp.asarray(0), dynamics.breakpoints[0])
    return np.asarray(evaluate(dynamics.force, panel, xi)) @ [1.0, speed**2, speed, *torque]


def best_torque(dynamics, speed):
    """Of a grid the torque that presses most at the start."""
    grid = [(one, two) for one in TORQUES for two in TORQUES]
    return max(grid, key=lambda torque: entry_force(dynamics, speed, torque).min())


@pytest.mark.parametrize("pace", [0.01, 0.05])
def test_the_opening_is_that_of_free_bodies(entry, pace):
    scene, dynamics, direction = entry
    z_dot = pace * direction  # the object moves at 10 or 50 mm/s
    impact = resolve_impact(dynamics, jnp.asarray(z_dot))
    assert (impact.impulse < 0).sum() == 1
    torque = best_torque(dynamics, float(impact.speed))
    force = entry_force(dynamics, float(impact.speed), torque)
    assert force.min() > 0
    found = contact_opening(dynamics, impact, jnp.asarray(force))
    j = int(found.contact)
    model, z = Model(to_dict(scene), scene.phases[2].formation.names), np.asarray(start_configuration(dynamics))
    panel, xi = locate_panel(dynamics, jnp.asarray(0), dynamics.breakpoints[0])
    signs = np.sign(model.reversing(z, np.asarray(evaluate(dynamics.velocity, panel, xi))))
    stay = np.arange(4) != j

    def without(z, z_dot):
        """The matrix of motion and constraints without contact `j`."""
        matrix, left = model.matrix(z, z_dot, signs)
        kept = np.append(np.full(5, True), stay)
        return matrix[np.ix_(kept, kept)], left[stay]

    matrix, _ = without(z, z_dot)
    mass = np.diag(matrix[:5, :5])
    answer = np.linalg.solve(matrix, np.concatenate([mass * z_dot, np.zeros(3)]))
    opens, others = answer[:5], answer[5:]
    assert model.geometry(z, opens)[1][j] @ opens > 0
    assert others.min() > 0

    def field(t, y):
        matrix, left = without(y[:5], y[5:])
        applied = model.contacts.applied(y[None, None, 5:], np.array(torque), signs[-2:])[0, 0]
        return np.concatenate([y[5:], np.linalg.solve(matrix, np.concatenate([applied, -left]))[:5]])

    def shut(t, y):
        return model.geometry(y[:5], y[5:])[0][j] - (1e-15 if t == 0 else 0.0)

    shut.terminal, shut.direction = True, -1.0
    duration = float(found.duration)
    run = solve_ivp(
        field,
        (0, 3 * duration),
        np.concatenate([z, opens]),
        rtol=1e-10,
        atol=1e-15,
        events=shut,
        max_step=duration / 50,
    )
    (closed,) = run.t_events[0]
    gaps = [model.geometry(y[:5], y[5:])[0][j] for y in run.y.T]
    assert closed == pytest.approx(duration, rel=0.05)
    first_height = float(impact.impulse[j]) ** 2 / (2 * force[j] * float(dynamics.contact_inertia[j, j]))
    assert max(gaps) == pytest.approx(first_height, rel=0.05)
    # The second impact leaves the object as fast as if the contact had pushed and pulled.
    matrix, _ = model.matrix(run.y[:5, -1], run.y[5:, -1], signs)
    shuts = np.linalg.solve(matrix, np.concatenate([mass * run.y[5:, -1], np.zeros(4)]))
    in_turn = shuts[5:] ** 2 / (2 * force * np.diagonal(dynamics.contact_inertia))
    assert float(found.height) == pytest.approx(in_turn[stay & (shuts[5:] < 0)].max(initial=first_height), rel=0.1)
    through = np.asarray(evaluate(dynamics.velocity, panel, xi)) * float(impact.speed)
    acceleration = model.solve(z, through, np.array(torque), signs)[0]
    np.testing.assert_allclose(shuts[:5], through + duration * acceleration, atol=0.02 * np.abs(through).max())


def test_what_does_not_close_again_is_open_without_end(entry):
    _, dynamics, direction = entry
    impact = resolve_impact(dynamics, jnp.asarray(0.01 * direction))
    pressed = jnp.ones(4)
    kept = contact_opening(dynamics, impact, pressed)
    assert 0 < float(kept.height) < 1e-6
    j = int(kept.contact)
    assert np.isinf(contact_opening(dynamics, impact, pressed.at[j].set(-1.0)).height), "no force closes it"
    rolling = eqx.tree_at(lambda d: d.tangential, dynamics, jnp.arange(4) == (j + 1) % 4)
    assert np.isinf(contact_opening(rolling, impact, pressed).height), "it rolls: its friction goes with it"
    two = impact._replace(impulse=impact.impulse.at[(j + 1) % 4].set(0.5 * float(impact.impulse[j])))
    assert np.isinf(contact_opening(dynamics, two, pressed).height), "two contacts would be pulled at"
    rest = contact_opening(dynamics, resolve_impact(dynamics, jnp.zeros(5)), pressed)
    assert (float(rest.height), float(rest.duration)) == (0.0, 0.0)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_contact_that_rolls_may_be_pushed_to_either_side_within_its_cone(entry, side):
    """Scenes and their mirror images are judged alike."""
    _, dynamics, direction = entry
    impact = resolve_impact(dynamics, jnp.asarray(0.01 * direction))
    impact = impact._replace(impulse=jnp.array([-0.01, 1.0, 1.0, 0.0]))  # the last two are one contact that rolls
    inertia = jnp.eye(4).at[2:, 0].set(jnp.array([1.0, 0.2 * side]))
    rolling = jnp.arange(4) == 3
    for friction, sticks in ((0.3, True), (0.1, False)):
        numbers = rolling, friction * rolling, inertia
        changed = eqx.tree_at(lambda d: (d.tangential, d.rolling_friction, d.contact_inertia), dynamics, numbers)
        found = contact_opening(changed, impact, jnp.ones(4))
        assert float(found.height) == (pytest.approx(0.01**2 / 2) if sticks else np.inf)


def test_an_impulse_that_pulls_by_rounding_opens_nothing(entry):
    _, dynamics, direction = entry
    impact = resolve_impact(dynamics, jnp.asarray(0.01 * direction))
    edge = IMPULSE_ROUNDING * float(impact.size)
    for share, opens in ((0.999, False), (1.001, True)):
        almost = impact._replace(impulse=jnp.abs(impact.impulse).at[1].set(-share * edge))
        found = contact_opening(dynamics, almost, jnp.ones(4))
        assert (float(found.height) > 0, int(found.contact)) == (opens, 1)


def test_a_contact_that_opens_farther_than_surfaces_are_rough_is_lost():
    """And one that opens less is kept, and told of."""
    scene = wa.load("flight")
    scene = eqx.tree_at(lambda s: s.object.friction, scene, scene.object.friction * jnp.array([1.2, 0.8, 0.8]))
    _, second, third = wa.simulate(scene, optimised("flight").torque).phases
    assert (second.opened, third.opened) == ("palm:v3", "palm:v3")
    assert min(second.impulses) < 0 > min(third.impulses)
    assert second.opening > MAX_OPENING > third.opening > 0
    assert (second.status, second.contact, second.time) == (wa.Status.CONTACT_LOST, "palm:v3", second.start)
    assert "the impact at its beginning opens it by 12 micrometres; press it harder there" in second.message
    assert third.status is not wa.Status.CONTACT_LOST


def test_under_a_law_objects_are_kept_where_contacts_open_for_an_instant():
    """Free bodies arrive so, with every contact touching (`benchmarks/feedback.py`)."""
    scene = wa.load("flight")
    law = wa.feedback(scene, optimised("flight").torque, friction=0.2)
    frictions = [scene.object.friction * jnp.array(factors) for factors in ((1.2, 0.8, 0.8), (1.2, 0.8, 1.2))]
    scenes = [eqx.tree_at(lambda s: s.object.friction, scene, friction) for friction in frictions]
    checked = wa.check(scenes, controller=law)
    for one, status in zip(scenes, checked.status, strict=True):
        result = closed_loop_result(one, law_tables(law))
        assert min(min(phase.impulses) for phase in result.phases[1:]) < 0
        assert result.message.startswith("ok")
        opened = [phase for phase in result.phases if phase.opened]
        assert all(f"{phase.opened} opens at its beginning, by" in phase.message for phase in opened)
        assert opened
        assert status == wa.Status.OK
