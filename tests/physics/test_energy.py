"""Energy: kinetic and potential energy change by the work of torques, contact friction and joint friction, no more."""

import jax.numpy as jnp
import numpy as np
import pytest
from support import DURATION, layered, passing

import wholearm_jax
from wholearm_jax.model.kinematics import contact_set, tangential_jacobian
from wholearm_jax.model.scene import Arrival, rigid_body
from wholearm_jax.phases.phase_simulation import simulate_phase
from wholearm_jax.phases.sampling import sample_phase
from wholearm_jax.simulation import IntegratorOptions

NODES = 8  # Gauss-Legendre points a step


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
def test_balance(name, phase):
    """Powers integrated over every step of a passage of the path against the change of energy."""
    scene = layered(name)
    solid, hand = rigid_body(scene.object), scene.hand
    several = contact_set(solid, hand, scene.phases[phase].formation)
    dynamics = wholearm_jax.trace(scene)[phase].dynamics
    torque, start, length = passing(dynamics), jnp.asarray(0.0), jnp.asarray(DURATION)
    motion = simulate_phase(
        dynamics, torque, start, length, IntegratorOptions(tolerance=1e-13, max_steps=512), Arrival.MOVING
    ).motion
    ends = np.asarray(motion.phase_time)[: int(motion.count) + 1]
    x, weight = np.polynomial.legendre.leggauss(NODES)
    low, high = ends[:-1, None], ends[1:, None]
    shares = (low + high) / 2 + (high - low) / 2 * x
    weights = ((high - low) / 2 * weight).ravel() * DURATION
    at = sample_phase(dynamics, torque, start, length, motion, jnp.asarray(shares.ravel()))
    z, z_dot = np.asarray(at.z), np.asarray(at.z_dot)
    slip = np.stack([np.asarray(tangential_jacobian(several, q)) @ rate for q, rate in zip(z, z_dot, strict=True)])
    joint = z_dot[:, 3:]
    work = {
        "torques": (np.asarray(at.torque) * joint).sum(1) @ weights,
        "contact friction": (np.asarray(at.ct) * slip).sum(1) @ weights,
        "viscous": -(np.asarray(hand.viscous) * joint**2).sum(1) @ weights,
        "dry": -(np.asarray(hand.dry) * np.abs(joint)).sum(1) @ weights,
    }
    inertia = np.array([solid.mass, solid.mass, solid.inertia, *hand.inertia], float)

    def energy(share):
        last = sample_phase(dynamics, torque, start, length, motion, jnp.asarray([share]))
        kinetic = (inertia * np.asarray(last.z_dot)[0] ** 2).sum() / 2
        return kinetic - float(solid.mass) * np.asarray(scene.gravity) @ np.asarray(last.z)[0, :2], kinetic

    (before, still), (after, kinetic) = energy(0.0), energy(ends[-1])
    print(work, "energy", after - before, "error", after - before - sum(work.values()))
    assert still == 0
    assert kinetic > 1e-3  # it moves
    assert all(part < -1e-3 for part in (work["contact friction"], work["viscous"], work["dry"]))
    assert abs(after - before - sum(work.values())) < 1e-9 * abs(work["torques"])
