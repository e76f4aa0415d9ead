"""Retraction: the curve along which a step is taken."""

import jax
import jax.numpy as jnp

from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import acceleration_terms
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.variables import Variables


def retract(p: Variables, direction: Variables, step_fraction, phase_dynamics: PathDynamics, limits: Limits):
    """Move `p` by a fraction of a direction, on the curve along which accelerations and internal forces change evenly.

    Torques nearly cancel, and the small remainder accelerates the object: where the state at a knot moves, torques have
    to move with it. On this curve the intervals are nearly linear; its tangent is the direction. A knot that crosses
    from one path segment to another, and one whose torques are fixed, moves along a straight line.
    """
    h = step_fraction

    def knot(dynamics, log, dlog, state, torque, dstate, dtorque, is_fixed):
        def motion(state, torque, log):
            at_zero, by_torque, squeeze = _torque_map(dynamics, state, log)
            return at_zero + by_torque @ torque, squeeze @ torque

        (a, f), (da, df) = jax.jvp(motion, (state, torque, log), (dstate, dtorque, dlog))
        new_state, straight = state + h * dstate, torque + h * dtorque
        at_zero, by_torque, squeeze = _torque_map(dynamics, new_state, log + h * dlog)
        size = by_torque @ by_torque
        curved = by_torque * (a + h * da - at_zero) / jnp.where(size > 0, size, 1.0) + squeeze * (f + h * df)
        before, after = _segment(dynamics, state), _segment(dynamics, new_state)
        return jnp.where((before == after) & (size > 0) & ~is_fixed, curved, straight)

    each_knot = jax.vmap(jax.vmap(knot, (None, None, None, 0, 0, 0, 0, 0)))
    log, dlog = p.log_duration, direction.log_duration
    torque = each_knot(
        phase_dynamics, log, dlog, p.state, p.torque, direction.state, direction.torque, limits.fixed_torques
    )
    return Variables(torque, p.state + h * direction.state, log + h * dlog)


def _torque_map(dynamics: PathDynamics, state, log_duration):
    """Return how torques act: acceleration at zero torque, its derivative by torques, internal-force direction.

    Accelerations are in path lengths a duration squared, torques over their limits.
    """
    terms = acceleration_terms(dynamics, dynamics.breakpoints[0] + dynamics.length * state[0])
    duration = jnp.exp(log_duration)
    v = state[1] * dynamics.length / duration
    at_zero = terms[0] + terms[1] * v**2 + terms[2] * v
    by_torque = terms[3:] * dynamics.torque_limit
    squeeze = jnp.stack([-by_torque[1], by_torque[0]]) / jnp.sqrt(jnp.maximum(by_torque @ by_torque, 1e-300))
    return duration**2 / dynamics.length * at_zero, duration**2 / dynamics.length * by_torque, squeeze


def _segment(dynamics: PathDynamics, state):
    """Return in which path segment a state lies."""
    return (dynamics.breakpoints[0] + dynamics.length * state[0] >= dynamics.breakpoints[1:-1]).sum()
