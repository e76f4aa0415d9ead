"""The path's motion against an independent simulation of all five coordinates (`unreduced.py`, NumPy and SciPy)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from support import DURATION, layered, passing

import wholearm_jax
from tests.reference import unreduced
from wholearm_jax.files import scene_toml as scene_file
from wholearm_jax.margin import quasistatic as squeeze
from wholearm_jax.model import Arrival
from wholearm_jax.phases.phase_ends import configuration, start_configuration
from wholearm_jax.phases.phase_simulation import simulate_phase
from wholearm_jax.phases.sampling import sample_phase
from wholearm_jax.simulation import IntegratorOptions


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0))
def configurations(dynamics, s):
    """`z` (SI) at places of a path."""
    segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
    return configuration(dynamics, segment, s)


def other_hand():
    """Offset links, unlike fingers, an inertia of its own, tilted gravity, another friction for each link."""
    data = scene_file.to_dict(layered("heptagon"))
    data["hand"]["finger1"] |= {"offset": 0.006, "length": 0.18, "inertia": 3e-3, "viscous": 0.03, "dry": 0.02}
    data["hand"]["finger2"] |= {"offset": 0.004, "inertia": 1.5e-3, "viscous": 0.01, "dry": 0.005}
    data["object"] |= {"friction": {"palm": 0.2, "finger1": 0.05, "finger2": 0.12}, "inertia": 1.5e-4}
    data["gravity"] = [0.8, -9.0]
    return wholearm_jax.parse(data)


SCENES = {
    "heptagon": lambda: layered("heptagon"),
    "hexagon": lambda: layered("hexagon"),
    "other hand": other_hand,
}
# Reversals on the way: the slip of contact 1 (`finger1:v1`) late in the heptagon's flip.
REVERSALS = {("heptagon", 1): [1], ("other hand", 1): [1]}


def compared(name, phase, tolerance, samples):
    """Errors of `z`, `z_dot`, `c_n` (each against its own size) over times from start to the path's end.

    The times are the integrator's own steps and `samples` even ones, also between a reversal and the end.
    """
    scene = SCENES[name]()
    dynamics = wholearm_jax.trace(scene)[phase].dynamics
    torque, start, length = passing(dynamics), jnp.asarray(0.0), jnp.asarray(DURATION)
    motion = simulate_phase(
        dynamics, torque, start, length, IntegratorOptions(tolerance=tolerance), Arrival.MOVING
    ).motion
    steps = np.asarray(motion.phase_time)[: int(motion.count) + 1]
    assert int(motion.status) == wholearm_jax.Status.LEFT_FORMATION
    assert 0.5 < steps[-1] < 1.0

    data = scene_file.to_dict(scene)
    model = unreduced.Model(data, data["phase"][phase]["contacts"])
    begin = np.asarray(sample_phase(dynamics, torque, start, length, motion, jnp.zeros(1)).z)[0]
    assert np.abs(model.geometry(begin, np.zeros(5))[0]).max() < 1e-14
    times, values = np.asarray(torque.times), np.asarray(torque.values)
    followed = model.simulate(begin, data["phase"][phase]["toward"], times, values, steps[-1] * DURATION)
    assert [which for _, which in followed.reversals] == REVERSALS.get((name, phase), [])

    shares = [steps] + ([np.linspace(0.0, steps[-1], samples)] if samples else [])
    for time, _ in followed.reversals:
        late = time / DURATION + (steps[-1] - time / DURATION) * np.linspace(0.05, 0.95, 10)
        shares.append(late if samples else steps[:0])
        assert time / DURATION < steps[-2]  # a step after the reversal is compared in any case
    shares = np.concatenate(shares)
    # The end may lie a rounding beyond the other simulation, and at a reversal forces jump.
    shares = np.minimum(shares, steps[-1] * (1 - 1e-12))
    for time, _ in followed.reversals:
        shares = shares[np.abs(shares - time / DURATION) > 1e-9]
    ours = sample_phase(dynamics, torque, start, length, motion, jnp.asarray(shares))
    z, z_dot, cn = (np.array(column) for column in zip(*(followed.at(t) for t in shares * DURATION), strict=True))
    assert cn.min() > 0.3  # both see compression throughout, so that relative errors mean something
    errors = np.abs(ours.z - z).max(), np.abs(ours.z_dot - z_dot).max(), np.abs(np.asarray(ours.cn) / cn - 1).max()
    print(f"{name}, phase {phase}: largest errors z %.1e, z_dot %.1e, c_n (relative) %.1e" % errors)
    return errors


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("name", SCENES)
def test_steps(name, phase):
    """At the default tolerance the integrator's steps agree."""
    z, z_dot, cn = compared(name, phase, 1e-10, 0)
    assert z < 1e-10
    assert z_dot < 1e-9
    assert cn < 1e-9


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("name", SCENES)
def test_between_steps(name, phase):
    """Short steps: the quintic between them agrees too, at any time."""
    z, z_dot, cn = compared(name, phase, 1e-13, 150)
    assert z < 1e-9
    assert z_dot < 1e-7
    assert cn < 1e-7


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("name", SCENES)
def test_the_moment_of_a_loss(name, phase):
    """Too weak a squeeze for a while: the plan arrives, but is lost when the other simulation says so."""
    scene = SCENES[name]()
    dynamics = wholearm_jax.trace(scene)[phase].dynamics
    torque = passing(dynamics)
    knot, middle = 3, dynamics.breakpoints[0] + 0.15 * dynamics.length
    motion_by, _ = (np.asarray(terms) for terms in squeeze.affine_coefficients(dynamics, middle))
    along = np.array([-motion_by[4], motion_by[3]]) / np.hypot(*motion_by[3:])  # torques that leave the motion alone

    def outcome(amount):
        weaker = wholearm_jax.TorqueSchedule(torque.times, torque.values.at[knot].add(amount * along))
        return weaker, simulate_phase(
            dynamics, weaker, 0.0, DURATION, IntegratorOptions(tolerance=1e-12), Arrival.ANY_SPEED
        )

    weaker, found = max(
        (outcome(amount) for amount in (-1.5, 1.5)), key=lambda one: np.isfinite(one[1].margin_result.loss_time)
    )
    assert int(found.motion.status) == wholearm_jax.Status.LEFT_FORMATION
    assert wholearm_jax.Status(int(found.assessment.status)) is wholearm_jax.Status.CONTACT_LOST
    lost, last = float(found.margin_result.loss_time), float(found.motion.phase_time[found.motion.count])
    assert 0.05 < lost < 0.6 < last

    data = scene_file.to_dict(scene)
    model = unreduced.Model(data, data["phase"][phase]["contacts"])
    begin = np.asarray(start_configuration(dynamics))
    times, values = np.asarray(weaker.times), np.asarray(weaker.values)
    until = (lost + 0.01) * DURATION  # tensile forces soon make no sense of friction
    followed = model.simulate(begin, data["phase"][phase]["toward"], times, values, until)
    grid = np.linspace(0.0, until, 400)
    tensile = np.array([followed.at(t)[2].min() for t in grid]) < 0
    first = int(np.argmax(tensile))
    assert first > 0
    moment = brentq(lambda t: followed.at(t)[2].min(), grid[first - 1], grid[first], xtol=1e-14)
    contact = int(np.argmin(followed.at(moment)[2]))
    assert lost * DURATION == pytest.approx(moment, abs=1e-8)
    assert int(found.margin_result.loss_contact) == int(found.assessment.contact) == contact


@pytest.mark.parametrize("contacts", [("palm:v5", "finger1:v1", "finger2:e3", "finger1:e0")])
def test_own_derivatives(contacts):
    """The other simulation's gap rows and second derivatives, fingertips on edges included, against differences."""
    data = scene_file.to_dict(other_hand())
    model = unreduced.Model(data, contacts)
    z, z_dot = np.array([0.01, 0.04, -0.3, 1.9, 0.9]), np.array([0.3, -0.2, 1.1, -0.7, 0.9])
    h = 1e-5

    def gaps(at):
        return model.geometry(at, z_dot)[0]

    rows = np.stack([(gaps(z + h * e) - gaps(z - h * e)) / (2 * h) for e in np.eye(5)], axis=1)
    _, gap_rows, _, left = model.geometry(z, z_dot)
    np.testing.assert_allclose(gap_rows, rows, atol=1e-9)
    rates = (model.geometry(z + h * z_dot, z_dot)[1] - model.geometry(z - h * z_dot, z_dot)[1]) @ z_dot / (2 * h)
    np.testing.assert_allclose(left, rates, atol=1e-9)


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
def test_start_after_waiting(name, phase):
    """Friction holds the object until the torque has risen enough: it starts at that time, from there."""
    scene = layered(name)
    dynamics = wholearm_jax.trace(scene)[phase].dynamics
    later, delay = passing(dynamics), 0.3
    held = squeeze.best_quasistatic_torque(
        dynamics, dynamics.breakpoints[0], 0.0, -0.5 * dynamics.length
    )  # slightly too weak to move
    times = np.concatenate([[0.0], delay + np.asarray(later.times)])
    values = np.concatenate([[held.torque], np.asarray(later.values)])
    torque, start, length = wholearm_jax.torque_schedule(times, values), jnp.asarray(0.0), jnp.asarray(times[-1])
    motion = simulate_phase(dynamics, torque, start, length, IntegratorOptions(tolerance=1e-12), Arrival.MOVING).motion
    assert bool(motion.at_rest[0])
    steps = np.asarray(motion.phase_time)[: int(motion.count) + 1]
    assert np.all(np.diff(steps) >= 0)
    departure, end = steps[1] * times[-1], steps[-1] * times[-1]
    assert 0.01 < departure < delay

    data = scene_file.to_dict(scene)
    model = unreduced.Model(data, data["phase"][phase]["contacts"])
    begin = np.asarray(sample_phase(dynamics, torque, start, length, motion, jnp.zeros(1)).z)[0]
    signs = np.sign(model.reversing(begin, model.direction(begin, data["phase"][phase]["toward"])))
    first = np.array([np.interp(departure, times, column) for column in values.T])
    # At departure the forward acceleration is zero by the other model too.
    assert np.abs(model.solve(begin, np.zeros(5), first, signs)[0]).max() < 1e-9
    # Moving off from exactly zero acceleration is all rounding: leave that to the first step after it.
    from_there = np.concatenate([[departure + 1e-9], times[times > departure]])
    rows = np.stack([np.interp(from_there, times, column) for column in values.T], axis=1)
    followed = model.simulate(begin, data["phase"][phase]["toward"], from_there, rows, end)
    # From above the departure on; the reversal near the heptagon's end has its own test.
    clock = np.linspace(departure + 0.01, departure + 0.95 * (end - departure), 40)
    z = np.array([followed.at(t)[0] for t in clock])
    assert np.ptp(z[:, 0]) > 0.02
    ours = sample_phase(dynamics, torque, start, length, motion, jnp.asarray(clock / times[-1]))
    error = np.abs(ours.z - z).max()
    print(f"{name}, phase {phase}: departs at {departure:.3f} s, largest error {error:.1e}")
    assert error < 1e-9


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
def test_which_way_an_object_at_rest_sets_out(name, phase):
    """With friction 0.5 the other simulation's accelerations, each with its own friction, allow either way, or both."""
    data = scene_file.to_dict(layered(name))
    data["object"]["friction"] = 0.5
    dynamics = wholearm_jax.trace(wholearm_jax.parse(data))[phase].dynamics
    model = unreduced.Model(data, data["phase"][phase]["contacts"])
    begin = np.asarray(start_configuration(dynamics))
    way = model.direction(begin, data["phase"][phase]["toward"])
    signs, still = np.sign(model.reversing(begin, way)), np.zeros(5)
    rng, met = np.random.default_rng(1), set()
    for _ in range(40):
        torque = rng.uniform(-1.0, 1.0, 2)
        ahead, behind = (model.solve(begin, still, torque, side * signs)[0] @ way for side in (1, -1))
        motion = simulate_phase(
            dynamics,
            wholearm_jax.torque_schedule([0.0, 1.0], [torque] * 2),
            0.0,
            1.0,
            IntegratorOptions(),
            Arrival.MOVING,
        ).motion
        waits, status = bool(motion.at_rest[0]), wholearm_jax.Status(int(motion.status))
        moves = int(motion.count) > 0 and not waits
        expected = (ahead > 0, behind < 0)
        met.add(expected)
        assert (status is wholearm_jax.Status.AMBIGUOUS) == (expected == (True, True))
        assert (status is wholearm_jax.Status.REVERSED and not moves) == (expected == (False, True))
        assert moves == (expected == (True, False))
        assert waits == (expected == (False, False))
    assert len(met) == 4


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
def test_wedged(name, phase):
    """Friction that turns the sign of the other simulation's determinant on the path is told, and no other."""
    data = scene_file.to_dict(layered(name))
    free = wholearm_jax.trace(layered(name))[phase].dynamics
    ends = np.asarray(free.breakpoints)[[0, -1]]
    places = ends[0] + np.ptp(ends) * np.linspace(0.0, 1.0, 101)
    found = []
    for friction in (0.5, 0.65, 0.8, 1.0, 1.2, 1.4):
        data["object"]["friction"] = friction
        model = unreduced.Model(data, data["phase"][phase]["contacts"])
        smooth = unreduced.Model(
            data | {"object": data["object"] | {"friction": 0.0}}, data["phase"][phase]["contacts"]
        )
        way, turned = None, []
        for z in np.asarray(configurations(free, jnp.asarray(places))):
            along = model.direction(z, data["phase"][phase]["toward"])
            way = along if way is None or along @ way > 0 else -along
            signs = np.sign(model.reversing(z, way))
            pair = (np.linalg.det(one.matrix(z, np.zeros(5), signs)[0]) for one in (model, smooth))
            turned.append(next(pair) * next(pair))
        status = wholearm_jax.Status(int(wholearm_jax.trace(wholearm_jax.parse(data))[phase].dynamics.status))
        assert (status is wholearm_jax.Status.SINGULAR) == (min(turned) < 0)
        found.append(min(turned) < 0)
    assert True in found
    assert False in found
