r"""A case with a solution on paper: a frictionless rectangle flush on the palm, a leaning finger on each upper corner.

Width `2 W`, height `H`, joints at `(+-X, 0)`, no offsets. With `x` the centre's place the finger's angles follow from
`x + W - X = H cot(theta1)`, `x - W + X = H cot(theta2)`, so that `theta' = -sin^2(theta) / H`,
`theta'' = -2 sin(theta) cos(theta) theta' / H` for both. One degree of freedom is left, with kinetic energy
`(m + J1 theta1'^2 + J2 theta2'^2) x_dot^2 / 2`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax
from wholearm_jax.dynamics import evaluate, locate_panel
from wholearm_jax.margin import quasistatic as squeeze

W, H, X, MASS, GRAVITY = 0.03, 0.06, 0.08, 0.2, 9.81
INERTIA = np.array([2e-3, 3e-3])
START, END = 0.03, -0.03
SMOOTH = {"viscous": (0.0, 0.0), "dry": (0.0, 0.0)}
ROUGH = {"viscous": (0.02, 0.03), "dry": (0.01, 0.02)}


def cornered(joints):
    """The rectangle slides from `START` to `END`."""
    fingers = [
        {"joint": [place, 0.0], "length": 0.17, "inertia": INERTIA[k], "torque_limit": 1.0}
        | {key: values[k] for key, values in joints.items()}
        for k, place in enumerate((X, -X))
    ]
    first = angles(START + 1e-4)
    return wholearm_jax.parse(
        {
            "title": "rectangle",
            "gravity": GRAVITY,
            "hand": {"fingers": "layered", "finger1": fingers[0], "finger2": fingers[1]},
            "object": {
                "vertices": [[-W, 0.0], [W, 0.0], [W, H], [-W, H]],
                "mass": MASS,
                "friction": 0.0,
            },
            # The start is only rough: the corners stay off the fingers until it is projected.
            "start": {"x": START, "y": H / 2 + 1e-4, "phi": 1e-4, "theta1": first[0], "theta2": first[1]},
            "phase": [
                {
                    "name": "slide",
                    "contacts": ["palm:v0", "palm:v1", "finger1:v2", "finger2:v3"],
                    "toward": "x-",
                    "duration": 1.0,
                    "until": {"x": END},
                }
            ],
        }
    )


def angles(x):
    """Both joint angles for the rectangle's place, in the last axis."""
    x = np.asarray(x)
    return np.stack([np.arctan2(H, x + W - X), np.arctan2(H, x - W + X)], axis=-1)


def by_hand(x, x_dot, torque, joints):
    """`x_ddot` by the energy method and the four forces by balances of fingers and object; travel to the left."""
    theta = angles(x)
    sin, cos = np.sin(theta), np.cos(theta)
    slope = -(sin**2) / H
    bend = -2 * sin * cos * slope / H
    heavy = MASS + (INERTIA * slope**2).sum()
    change = (2 * INERTIA * slope * bend).sum()
    # To the left both angles grow.
    spin = slope * x_dot
    net = np.asarray(torque) - np.array(joints["viscous"]) * spin - np.array(joints["dry"])
    x_ddot = (net @ slope - change * x_dot**2 / 2) / heavy
    theta_ddot = slope * x_ddot + bend * x_dot**2
    # Finger 1 presses at distance H / sin(theta1) against its positive sense, finger 2 in its own.
    one, two = (net - INERTIA * theta_ddot) * sin / H * np.array([1.0, -1.0])
    total = MASS * GRAVITY - one * cos[0] + two * cos[1]
    # Moment about the centre: W (right - left) + ... = 0.
    moment = one * (W * cos[0] + H / 2 * sin[0]) + two * (W * cos[1] - H / 2 * sin[1])
    left, right = (total + moment / W) / 2, (total - moment / W) / 2
    return x_ddot, theta_ddot, spin, np.array([left, right, one, two])


@pytest.fixture(scope="module", params=[SMOOTH, ROUGH], ids=["smooth joints", "rough joints"])
def slide(request):
    """The joints' friction, the traced path, places `s` along it and the table's `z` there."""
    traced = wholearm_jax.trace(cornered(request.param))[0]
    dynamics = traced.dynamics
    assert int(dynamics.status) == wholearm_jax.Status.OK
    s = dynamics.breakpoints[0] + dynamics.length * jnp.linspace(0.0, 1.0, 101)

    def configuration(s):
        segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
        panel, xi = locate_panel(dynamics, segment, s)
        return evaluate(dynamics.configuration, panel, xi)

    return request.param, traced, s, np.asarray(jax.jit(jax.vmap(configuration))(s))


def test_path(slide):
    """The whole path, from the start's projection to where the scene ends it."""
    _, _, _, z = slide
    np.testing.assert_allclose(z[:, 1], H / 2, atol=1e-11, rtol=0)
    np.testing.assert_allclose(z[:, 2], 0.0, atol=1e-11)
    np.testing.assert_allclose(z[:, 3:], angles(z[:, 0]), atol=1e-11, rtol=0)
    assert abs(z[-1, 0] - END) < 1e-11
    assert abs(z[0, 0] - START) < 1e-3
    assert np.all(np.diff(z[:, 0]) < 0)


def test_holding_forces(slide):
    """Torques of `best_quasistatic_torque` at rest: in balance, and their least force is that of the paper solution."""
    joints, traced, s, z = slide
    held = squeeze.best_quasistatic_torque_batch(traced.dynamics, s, jnp.zeros_like(s), jnp.zeros_like(s))
    for x, torque, margin in zip(z[:, 0], np.asarray(held.torque), np.asarray(held.margin), strict=True):
        x_ddot, _, _, forces = by_hand(x, 0.0, torque, joints)
        assert abs(x_ddot) < 1e-9
        assert margin > 0.1
        assert abs(forces.min() - margin) < 1e-9 * margin
        sin, cos = np.sin(angles(x)), np.cos(angles(x))
        assert abs(forces[3] * sin[1] - forces[2] * sin[0]) < 1e-9  # the fingers' pushes cancel
        assert abs(forces[:2].sum() + forces[2] * cos[0] - forces[3] * cos[1] - MASS * GRAVITY) < 1e-9


@pytest.mark.parametrize("speed", [0.0, 0.4])
@pytest.mark.parametrize("torque", [(0.3, -0.1), (0.05, -0.4)])
def test_moving(slide, speed, torque):
    """Acceleration and all four forces for given torques at rest and in motion."""
    joints, traced, s, z = slide
    dynamics, path = traced.dynamics, traced.path
    acceleration, force = (np.asarray(a) for a in jax.vmap(squeeze.affine_coefficients, (None, 0))(dynamics, s))
    unit = 1 / np.hypot(W, H / 2)  # s is a coordinate of z in the object's own unit of length
    segments = np.minimum(
        (np.asarray(s)[:, None] >= np.asarray(dynamics.breakpoints)[1:-1]).sum(1), int(dynamics.count) - 1
    )
    for x, segment, a_row, f_rows in zip(z[:, 0], segments, acceleration, force, strict=True):
        u = np.asarray(path.chart[segment])
        x_ddot, theta_ddot, spin, forces = by_hand(x, -speed, torque, joints)
        v = u @ np.array([-speed * unit, 0.0, 0.0, *spin])
        a = u @ np.array([x_ddot * unit, 0.0, 0.0, *theta_ddot])
        terms = np.array([1.0, v**2, v, *torque])
        assert abs(a_row @ terms - a) < 1e-9 * max(abs(a), 1.0)
        np.testing.assert_allclose(f_rows @ terms, forces, atol=1e-9 * np.abs(forces).max(), rtol=0)
