"""Rolling contacts: formations with two constraints a contact, against independent simulations and forces by hand."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_modes_and_differences_agree, layered, passing

import wholearm_jax
from tests.reference import unreduced
from wholearm_jax.dynamics import evaluate, locate_panel
from wholearm_jax.files import scene_toml as scene_file
from wholearm_jax.margin import margin_upper_bound
from wholearm_jax.margin import quasistatic as squeeze
from wholearm_jax.model.kinematics import (
    anchor_rolling,
    constraint_jacobian,
    constraint_second_derivative,
    constraints,
    contact_set,
    tangential_jacobian,
)
from wholearm_jax.model.scene import Arrival, contact_formation, rigid_body
from wholearm_jax.model.schedule import TorqueSchedule
from wholearm_jax.phases.phase_simulation import simulate_phase
from wholearm_jax.phases.sampling import sample_phase
from wholearm_jax.simulation import IntegratorOptions

DURATION = 1.0


def tipping(contacts=None, toward=None, **start):
    """The bundled scene as a dict, one phase of it, perhaps with other contacts from another start."""
    data = scene_file.to_dict(layered("tipping"))
    data["phase"] = data["phase"][:1]
    data["phase"][0] |= {"duration": DURATION} | ({"contacts": contacts} if contacts else {})
    data["phase"][0] |= {"toward": toward} if toward else {}
    data["start"] |= start
    return data


def other_hand(data):
    """Unlike fingers with offsets, another friction for each link, tilted gravity."""
    data["hand"]["finger1"] |= {"offset": 0.003, "inertia": 3e-3, "viscous": 0.03, "dry": 0.02}
    data["hand"]["finger2"] |= {"offset": 0.002, "length": 0.18, "viscous": 0.01, "dry": 0.005}
    data["object"]["friction"] = {"palm": 0.7, "finger1": 0.05, "finger2": 0.12}
    data["gravity"] = [0.3, -9.6]
    return data


def carried():
    """Off the palm, a corner held still on each finger: a four-bar linkage."""
    data = tipping(["finger1:v2 rolling", "finger2:v3 rolling"], "phi-", y=0.055, phi=-1.3)
    data["object"]["friction"] = 0.8
    return data


def on_the_finger():
    """The corner on the palm slides, that on finger 1 does not."""
    data = tipping(["palm:v0", "finger1:v2 rolling", "finger2:v3"], phi=-1.3)
    data["object"]["friction"] = {"palm": 0.1, "finger1": 0.6, "finger2": 0.1}
    return data


def carrying(dynamics, knots=33):
    """The least torques for a steady acceleration along a path and past its end, whatever the contacts bear."""
    u = 1.1 * jnp.linspace(0.0, 1.0, knots)
    length, rate = dynamics.length, 1.1 / DURATION
    places, v, a = (
        dynamics.breakpoints[0] + length * jnp.minimum(u, 1.0) ** 2,
        2 * length * u * rate,
        2 * length * rate**2,
    )
    motion = jax.vmap(lambda s: squeeze.affine_coefficients(dynamics, s)[0])(places)
    rest = motion[:, 0] + motion[:, 1] * v**2 + motion[:, 2] * v
    pull = motion[:, 3:]
    values = pull * ((a - rest) / (pull**2).sum(1))[:, None]
    return wholearm_jax.torque_schedule(np.linspace(0.0, DURATION, knots), values)


SCENES = {
    "palm": tipping,
    "palm, other hand": lambda: other_hand(tipping(phi=-1.35)),
    "finger": on_the_finger,
    "both fingers": carried,
}


@pytest.fixture(scope="module", params=SCENES)
def rolling(request):
    """A scene, its traced path, and torques that carry the object along it."""
    data = SCENES[request.param]()
    scene = wholearm_jax.parse(data)
    traced = wholearm_jax.trace(scene)[0]
    assert int(traced.dynamics.status) == wholearm_jax.Status.OK
    return data, traced, carrying(traced.dynamics)


@pytest.mark.parametrize(
    "names", [["palm:v5 rolling", "finger1:v1 rolling"], ["finger2:v3 rolling", "finger1:e0 rolling"]]
)
def test_rows_are_gradients(names):
    """Rows and curvature of the constraints against automatic derivatives, off contact too."""
    scene = wholearm_jax.parse(other_hand(tipping()))
    z, x = jnp.array([0.012, 0.043, -0.3, 1.9, 0.9]), jnp.array([0.3, -0.2, 1.1, -0.7, 0.9])
    several = contact_set(rigid_body(scene.object), scene.hand, contact_formation(names))
    several = anchor_rolling(several, z + 0.1)
    rows = constraint_jacobian(several, z)
    np.testing.assert_allclose(rows, jax.jacfwd(lambda z: constraints(several, z))(z), atol=1e-15)
    hessian = jax.jacfwd(jax.jacfwd(lambda z: constraints(several, z)))(z)
    np.testing.assert_allclose(constraint_second_derivative(several, z, x), x @ hessian @ x, atol=1e-14)
    np.testing.assert_allclose(rows[1::2], tangential_jacobian(several, z)[1::2], rtol=1e-14)


def test_the_other_simulation_rolls_without_drift():
    """Its own derivative of `G_t` against differences."""
    model = unreduced.Model(other_hand(tipping()), ["palm:v5 rolling", "finger1:v1 rolling", "finger2:e3 rolling"])
    z, z_dot, h = np.array([0.01, 0.04, -0.3, 1.9, 0.9]), np.array([0.3, -0.2, 1.1, -0.7, 0.9]), 1e-5
    ahead, behind = (model.geometry(z + sign * h * z_dot, z_dot)[2] for sign in (1, -1))
    np.testing.assert_allclose(model.rolling(z, z_dot)[1], (ahead - behind) @ z_dot / (2 * h), atol=1e-9)


def test_against_unreduced(rolling):
    """Motion and all forces of a passage against the independent simulation of five coordinates."""
    data, traced, torque = rolling
    dynamics, start, length = traced.dynamics, jnp.asarray(0.0), jnp.asarray(DURATION)
    motion = simulate_phase(dynamics, torque, start, length, IntegratorOptions(tolerance=1e-13), Arrival.MOVING).motion
    assert int(motion.status) == wholearm_jax.Status.LEFT_FORMATION
    end = float(motion.phase_time[motion.count]) * (1 - 1e-12)
    steps = np.asarray(motion.phase_time)[: int(motion.count)]

    names = data["phase"][0]["contacts"]
    model = unreduced.Model(data, names)
    begin = np.asarray(sample_phase(dynamics, torque, start, length, motion, jnp.zeros(1)).z)[0]
    times, values = np.asarray(torque.times), np.asarray(torque.values)
    followed = model.simulate(begin, data["phase"][0]["toward"], times, values, end * DURATION)
    shares = np.concatenate([steps, np.linspace(0.0, end, 150)])
    ours = sample_phase(dynamics, torque, start, length, motion, jnp.asarray(shares))
    z, z_dot, forces = (np.array(column) for column in zip(*(followed.at(t) for t in shares * DURATION), strict=True))
    count, rolls = len(names), model.rolls
    cn, ct = np.asarray(ours.cn), np.asarray(ours.ct)
    size = np.abs(forces).max()
    assert np.abs(ours.z - z).max() < 1e-8
    assert np.abs(ours.z_dot - z_dot).max() < 1e-7
    assert np.abs(cn[:, :count] - forces[:, :count]).max() < 1e-6 * size
    assert np.abs(ct[:, :count][:, rolls] - forces[:, count:]).max() < 1e-6 * size
    assert np.all(np.isnan(cn[:, count:]))
    assert np.all(np.isnan(ct[:, count:]))
    # The motion is a real one, and the places where contacts roll stay.
    assert np.ptp(z[:, 2]) > 0.1 or np.ptp(z[:, 3:], axis=0).max() > 0.1
    moved = np.array(
        [
            model.geometry(q, rate)[2][rolls] @ rate
            for q, rate in zip(np.asarray(ours.z), np.asarray(ours.z_dot), strict=True)
        ]
    )
    assert np.abs(moved).max() < 1e-11


def test_energy(rolling):
    """A rolling contact does no work: energy changes by what torques, sliding friction and the joints do."""
    data, traced, torque = rolling
    scene, dynamics = wholearm_jax.parse(data), traced.dynamics
    start, length = jnp.asarray(0.0), jnp.asarray(DURATION)
    motion = simulate_phase(
        dynamics, torque, start, length, IntegratorOptions(tolerance=1e-13, max_steps=512), Arrival.MOVING
    ).motion
    ends = np.asarray(motion.phase_time)[: int(motion.count) + 1]
    x, weight = np.polynomial.legendre.leggauss(8)
    low, high = ends[:-1, None], ends[1:, None]
    shares, weights = ((low + high) / 2 + (high - low) / 2 * x).ravel(), ((high - low) / 2 * weight).ravel() * DURATION
    at = sample_phase(dynamics, torque, start, length, motion, jnp.asarray(shares))
    solid, hand, count = rigid_body(scene.object), scene.hand, len(data["phase"][0]["contacts"])
    names = [name.removesuffix(" rolling") for name in data["phase"][0]["contacts"]]
    several = contact_set(solid, hand, contact_formation(names))
    slip = np.asarray(jax.vmap(lambda z, rate: tangential_jacobian(several, z) @ rate)(at.z, at.z_dot))
    joint = np.asarray(at.z_dot)[:, 3:]
    power = (np.asarray(at.torque) * joint).sum(1) + (np.asarray(at.ct)[:, :count] * slip).sum(1)
    power -= (np.asarray(hand.viscous) * joint**2 + np.asarray(hand.dry) * np.abs(joint)).sum(1)
    inertia = np.array([solid.mass, solid.mass, solid.inertia, *hand.inertia], float)

    def energy(share):
        last = sample_phase(dynamics, torque, start, length, motion, jnp.asarray([share]))
        kinetic = (inertia * np.asarray(last.z_dot)[0] ** 2).sum() / 2
        return kinetic - float(solid.mass) * np.asarray(scene.gravity) @ np.asarray(last.z)[0, :2]

    change = energy(ends[-1]) - energy(0.0)
    assert abs(change - power @ weights) < 1e-9 * np.abs((np.asarray(at.torque) * joint).sum(1) @ weights)


def test_pivot_by_hand():
    """Forces by hand, without friction on the fingers: the corner is a pivot, each finger a lever.

    With the corner at rest at `P`, the object turns about it and the finger through vertex `V` has
    `theta' = d theta / d phi = (r . (V - P)) / |V - j|` with `r` along the finger. Lagrange's equation in `phi` gives
    the acceleration, the fingers' moment balances their forces, and Newton's law the force at the corner.
    """
    data = tipping()
    data["object"]["friction"] = {"palm": 0.6, "finger1": 0.0, "finger2": 0.0}
    for finger in (data["hand"][name] for name in ("finger1", "finger2")):
        finger |= {"dry": 0.0, "viscous": 0.0}
    traced = wholearm_jax.trace(wholearm_jax.parse(data))[0]
    dynamics, path = traced.dynamics, traced.path
    area, centroid, second = unreduced.uniform(data["object"]["vertices"])
    vertices = np.array(data["object"]["vertices"]) - centroid
    mass, inertia = data["object"]["mass"], data["object"]["mass"] * second / area
    s = np.linspace(float(dynamics.breakpoints[0]), float(dynamics.breakpoints[-1]), 9)[1:-1]
    _, force = (np.asarray(a) for a in jax.vmap(squeeze.affine_coefficients, (None, 0))(dynamics, jnp.asarray(s)))
    torque, v = np.array([0.11, -0.34]), 0.7
    for where, f_rows in zip(s, force, strict=True):
        panel, xi = locate_panel(dynamics, jnp.asarray(0), jnp.asarray(where))
        z = np.asarray(evaluate(dynamics.configuration, panel, xi))
        x = np.asarray(evaluate(dynamics.velocity, panel, xi))
        spin = x[2] * v
        rates, bends, arms, pushes = [], [], [], []
        turn = np.array([[np.cos(z[2]), -np.sin(z[2])], [np.sin(z[2]), np.cos(z[2])]])
        for k, vertex in enumerate((2, 3)):
            joint, away = np.array(data["hand"][f"finger{k + 1}"]["joint"]), turn @ (vertices[vertex] - vertices[0])
            reach = z[:2] + turn @ vertices[vertex] - joint
            # theta = arg(reach), reach' = S away, reach'' = -away, by the phase's derivatives in phi.
            d, dd = unreduced.quarter(away), -away
            square = reach @ reach
            cross = reach[0] * d[1] - reach[1] * d[0]
            rates.append(cross / square)
            bends.append((reach[0] * dd[1] - reach[1] * dd[0]) / square - 2 * cross * (reach @ d) / square**2)
            arms.append(np.sqrt(square))
            pushes.append((1 if k == 0 else -1) * unreduced.quarter(reach) / np.sqrt(square))
        rates, bends, arms = np.array(rates), np.array(bends), np.array(arms)
        levers = np.array([f["inertia"] for f in (data["hand"][name] for name in ("finger1", "finger2"))])
        centre = -turn @ vertices[0]  # from the pivot to the centre of mass
        total = inertia + mass * centre @ centre + levers @ rates**2
        pull = torque @ rates - mass * data["gravity"][1] * -centre[0] - levers @ (rates * bends) * spin**2
        phi_ddot = pull / total
        theta_ddot = rates * phi_ddot + bends * spin**2
        # Moment about a finger's joint: J theta_ddot = tau - side * c * arm.
        squeezed = (torque - levers * theta_ddot) / arms * np.array([1, -1])
        motion = unreduced.quarter(centre) * phi_ddot - centre * spin**2
        corner = mass * (motion - np.array(data["gravity"])) - squeezed @ np.array(pushes)
        expected = np.array([corner[1], corner[0], *squeezed])  # normal up, tangent to the right
        terms = np.array([1.0, v**2, v, *torque])
        np.testing.assert_allclose(f_rows @ terms, expected, atol=1e-9 * np.abs(expected).max(), rtol=0)
    assert float(path.length) > 0.3


def test_cone_counts_toward_the_margin():
    """The margin is the least of every `c_n` and `mu c_n - |c_t|`; a palm a little less rough than needed slips."""
    data = tipping()
    scene = wholearm_jax.parse(data)
    torque = wholearm_jax.quasistatic(scene)
    result = wholearm_jax.simulate(scene, torque)
    course = wholearm_jax.trajectory(result, 4001)[0]
    cn, ct = np.asarray(course.cn)[:, :3], np.asarray(course.ct)[:, :3]
    moving = np.isfinite(cn[:, 0])
    cone = 0.6 * cn[:, 0] - np.abs(ct[:, 0])
    least = min(np.nanmin(cn), cone[moving].min())
    assert result.margin <= least + 1e-12
    assert result.margin == pytest.approx(least, rel=1e-4)
    assert result.phases[0].margin_contact == "palm:v0 rolling"

    smooth = 0.98 * (np.abs(ct[moving, 0]) / cn[moving, 0]).max()
    data["object"]["friction"]["palm"] = float(smooth)
    slipping = wholearm_jax.simulate(wholearm_jax.parse(data), torque)
    assert slipping.status is wholearm_jax.Status.CONTACT_LOST
    assert "contact_lost at palm:v0 rolling" in slipping.message
    assert "slips" in slipping.message
    assert cn.min(initial=np.inf, where=moving[:, None]) > 0  # nothing pulls


def test_bound_and_hold_see_the_cone(rolling):
    """`best_quasistatic_torque` against a dense scan of the squeeze; the bound is not below it."""
    _, traced, _ = rolling
    dynamics = traced.dynamics
    s = dynamics.breakpoints[0] + 0.4 * dynamics.length
    found = squeeze.best_quasistatic_torque(dynamics, s)
    motion, force = (np.asarray(a) for a in squeeze.affine_coefficients(dynamics, s))
    pull = motion[3:]
    base, free = -pull * motion[0] / (pull @ pull), np.array([-pull[1], pull[0]]) / np.linalg.norm(pull)
    tau = base + np.linspace(-3.0, 3.0, 200001)[:, None] * free
    forces = force[:, 0] + tau @ force[:, 3:].T
    grip, tangential = np.asarray(dynamics.rolling_friction), np.asarray(dynamics.tangential)
    slack = np.where(tangential, grip * np.roll(forces, 1, axis=1) - np.abs(forces), forces).min(1)
    slack[np.any(np.abs(tau) > np.asarray(dynamics.torque_limit), axis=1)] = -np.inf
    assert float(found.margin) == pytest.approx(slack.max(), abs=2e-3)
    assert float(found.margin) >= slack.max() - 1e-12
    at = jax.vmap(lambda s: squeeze.best_quasistatic_torque(dynamics, s).margin)(
        dynamics.breakpoints[0] + dynamics.length * jnp.linspace(0.0, 1.0, 65)
    )
    assert float(margin_upper_bound(dynamics, jnp.asarray(DURATION), False, False).value) >= float(at.min()) - 1e-9


def test_gradients():
    """Forward mode, reverse mode and differences of the margin, the cone's side deciding it."""
    data = tipping()
    data["phase"][0]["duration"] = 0.6
    scene = wholearm_jax.parse(data)
    even = wholearm_jax.quasistatic(scene)
    assert_modes_and_differences_agree(scene, TorqueSchedule(1.01 * even.times, 1.01 * even.values), seed=5)


def test_mirror_image():
    """`x -> -x` with the fingers swapped: the same margin and the tangential force reversed."""
    data = other_hand(tipping(phi=-1.35))
    torque = passing(wholearm_jax.trace(wholearm_jax.parse(data))[0].dynamics)
    mirrored, count = copy.deepcopy(data), len(data["object"]["vertices"])
    swap = {"finger1": "finger2", "finger2": "finger1"}
    fingers = {name: data["hand"][name] for name in swap}
    mirrored["hand"] |= {swap[k]: f | {"joint": [-f["joint"][0], f["joint"][1]]} for k, f in fingers.items()}
    solid = mirrored["object"]
    solid["vertices"] = [[-x, y] for x, y in reversed(solid["vertices"])]
    solid["friction"] = {swap.get(k, k): value for k, value in solid["friction"].items()}
    mirrored["gravity"][0] *= -1
    start = data["start"]
    mirrored["start"] = {"x": -start["x"], "y": start["y"], "phi": -start["phi"]}
    mirrored["start"] |= {"theta1": np.pi - start["theta2"], "theta2": np.pi - start["theta1"]}
    names = {
        f"{link}:v{k}": f"{swap.get(link, link)}:v{count - 1 - k}" for link in ("palm", *swap) for k in range(count)
    }
    phase = mirrored["phase"][0]
    phase["contacts"] = [text.replace(text.split()[0], names[text.split()[0]]) for text in phase["contacts"]]
    phase["toward"] = "phi+"
    other = wholearm_jax.torque_schedule(torque.times, -np.asarray(torque.values)[:, ::-1])
    one, two = (wholearm_jax.simulate(wholearm_jax.parse(d), t) for d, t in ((data, torque), (mirrored, other)))
    assert one.status == two.status == wholearm_jax.Status.LEFT_FORMATION
    assert one.margin == pytest.approx(two.margin, rel=1e-10)
    ours, theirs = (wholearm_jax.trajectory(r, 11)[0] for r in (one, two))
    np.testing.assert_allclose(ours.ct[:-1], -theirs.ct[:-1], atol=1e-9)
    np.testing.assert_allclose(ours.cn[:-1], theirs.cn[:-1], atol=1e-9)


def test_bundled_plan_is_optimised():
    """Both ways over the vertex, within 3 % of the bound."""
    found = wholearm_jax.optimise(layered("tipping"))
    assert found.result.status is wholearm_jax.Status.OK, found.result.message
    assert min(found.bound_fraction) >= 0.97
    assert max(found.bound_fraction) <= 1.0
