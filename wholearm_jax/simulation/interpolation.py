"""Dense output: the steps of a motion as quintic polynomials of phase time.

Between accepted steps `s(u)` is the quintic with the right `s`, `ds/du` and `d2s/du2` at both ends, so that motion and
forces are known at every time. Derivation: section 7 of `docs/derivation.md`.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.dynamics import PathDynamics, differentiate_polynomial, evaluate_polynomial
from wholearm_jax.simulation.closed_loop import Actuation, PhaseLoop, memory_rate
from wholearm_jax.simulation.motion_record import Motion
from wholearm_jax.simulation.path_ode import path_acceleration


class DenseOutput(eqx.Module):
    """The steps of a motion, with all that the forces within a step depend on."""

    phase_time: Float[Array, "steps 2"]  # at both ends of a step
    quintic: Float[Array, "steps 6"]  # s as a polynomial in xi in [0, 1], lowest power first
    segment: Int[Array, "steps"]  # of the path
    row: Int[Array, "steps"]  # interval of the torque schedule
    at_rest: Bool[Array, "steps"]  # whether friction holds the object
    live: Bool[Array, "steps"]  # whether there is such a step, and it takes time
    memory: Float[Array, "steps 4 memory"] | None = None  # of a closed-loop law, as cubic polynomials in xi


def dense_output(
    dynamics: PathDynamics, phase_schedule: Actuation, duration: float | Float[Array, ""], motion: Motion
) -> DenseOutput:
    """Interpolate the steps of a motion."""
    # A step that takes no time has no speed of its own: its neighbours hold the speeds before and after it.
    live = (jnp.arange(motion.at_rest.shape[0]) < motion.count) & (motion.phase_time[1:] > motion.phase_time[:-1])
    phase_time, s = (jnp.stack([a[:-1], a[1:]], axis=1) for a in (motion.phase_time, motion.s))
    w = jnp.stack([motion.w_begin, motion.w[1:]], axis=1)
    memory = None if motion.memory is None else jnp.stack([motion.memory[:-1], motion.memory[1:]], axis=1)
    axes = None, None, None, 0, 0, 0, 0, 0, 0, None if memory is None else 0
    quintic = jax.vmap(quintic_hermite, axes)(
        dynamics, phase_schedule, duration, phase_time, s, w, motion.segment, motion.row, live & ~motion.at_rest, memory
    )
    steps = DenseOutput(phase_time, quintic, motion.segment, motion.row, motion.at_rest, live)
    if not isinstance(phase_schedule, PhaseLoop):
        return steps
    return replace(steps, memory=_cubics(dynamics, phase_schedule, duration, steps, s, memory))


def _cubics(dynamics, loop: PhaseLoop, duration, steps: DenseOutput, s, memory) -> Float[Array, "steps 4 memory"]:
    """Interpolate the memory of a law in each step: cubic polynomials with the right values and rates at both ends."""

    def cubic(phase_time, segment, row, s, memory):
        rate = jax.vmap(memory_rate, (None, None, None, None, None, 0, 0, 0))(
            loop, dynamics, duration, segment, row, phase_time, s, memory
        )
        d0, d1 = rate * (phase_time[1] - phase_time[0])
        rise = memory[1] - memory[0]
        return jnp.stack([memory[0], d0, 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise])

    return jax.vmap(cubic)(steps.phase_time, steps.segment, steps.row, s, memory)


def quintic_hermite(
    dynamics: PathDynamics, phase_schedule: Actuation, duration, phase_time, s, w, segment, row, is_moving, memory=None
) -> Float[Array, "6"]:
    """Compute the coefficients of the quintic Hermite polynomial of a step in `xi` in [0, 1].

    Args:
        dynamics: Tabulated path dynamics.
        phase_schedule: Torque schedule of the phase.
        duration: Duration of the phase [s].
        phase_time: Phase time at both ends (2,).
        s: `s` at both ends (2,).
        w: `ds/du` at both ends (2,).
        segment: Segment of the path.
        row: Interval of the schedule.
        is_moving: Whether the object moves; else `s` is constant.
        memory: Memory of a closed-loop law at both ends (2, memory); None in open loop.
    """
    width = phase_time[1] - phase_time[0]
    acceleration = jax.vmap(path_acceleration, (None, None, None, None, None, 0, 0, 0, None if memory is None else 0))(
        dynamics, phase_schedule, duration, segment, row, phase_time, s, w, memory
    )
    d0, d1 = jnp.where(is_moving, w * width, 0.0)
    b0, b1 = jnp.where(is_moving, acceleration * width**2, 0.0)
    rise = s[1] - s[0]
    # A step as short as the rounding of `s`, as across a tiny segment, would take its speed from that rounding.
    hermite_rise = (d0 + d1) / 2 + (b0 - b1) / 12
    is_rounding = jnp.abs(rise - hermite_rise) < 8 * jnp.finfo(rise.dtype).eps * jnp.abs(s[1])
    rise = jnp.where(is_rounding, hermite_rise, rise)
    quintic = [
        s[0],
        d0,
        b0 / 2,
        10 * rise - 6 * d0 - 4 * d1 - 1.5 * b0 + b1 / 2,
        -15 * rise + 8 * d0 + 7 * d1 + 1.5 * b0 - b1,
        6 * rise - 3 * (d0 + d1) - (b0 - b1) / 2,
    ]
    return jnp.stack(quintic)


def evaluate_dense(step: DenseOutput, xi: Float[Array, ""]):
    """Evaluate phase time, `s` and `w` at `xi` in [0, 1] of one step (a `DenseOutput` without leading axis)."""
    width = step.phase_time[1] - step.phase_time[0]
    s = evaluate_polynomial(step.quintic, xi)
    slope = evaluate_polynomial(differentiate_polynomial(step.quintic), xi)
    is_moving = step.live & ~step.at_rest
    w = jnp.where(is_moving, slope / jnp.where(is_moving, width, 1.0), 0.0)
    return step.phase_time[0] + xi * width, s, w


def evaluate_memory(step: DenseOutput, xi: Float[Array, ""]) -> Float[Array, "memory"] | None:
    """Evaluate the memory of a closed-loop law at `xi` in [0, 1] of one step; None in open loop."""
    return None if step.memory is None else evaluate_polynomial(step.memory, xi)
