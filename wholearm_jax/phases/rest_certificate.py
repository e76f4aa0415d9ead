r"""Rest: a proof that friction can hold an object that stands still, without a linear programme.

Of an object that friction keeps at rest the forces are not determined (`holding`). But for each share `k` of its
friction, with the signs of setting out forward, the equations of motion have an acceleration `a(k)` and forces `c(k)`,
linear in the torque; and `a(1) <= 0 <= a(-1)` at rest. Between two shares with `a(k1) <= 0 <= a(k0)` the mean of both
in which the accelerations cancel balances, and its friction is within every cone if that of `c(k0)` and `c(k1)` is.
The interval of shares is halved until this holds. Where it never does, the rest may still be possible: that is for the
linear programme to say.

Derivation: section 4 of `docs/derivation.md`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import fused_matmul, inverse_and_determinant, take_row
from wholearm_jax.dynamics import PathDynamics, equations_of_motion, evaluate, locate_panel
from wholearm_jax.margin import force_slack
from wholearm_jax.model import (
    TIME_ROUNDING,
    PhaseSchedule,
    ScaledMechanics,
    TorqueSchedule,
    restrict_to_phase,
    torque_at,
)
from wholearm_jax.phases.phase_simulation import SimulatedPhase
from wholearm_jax.phases.result import MIN_REST
from wholearm_jax.simulation import Actuation, Motion, PhaseLoop, torques_of_step

HALVINGS = 20  # of the interval of shares


def certify_rest(
    mechanics: ScaledMechanics, dynamics: PathDynamics, schedule: TorqueSchedule | PhaseLoop, done: SimulatedPhase
) -> Bool[Array, ""]:
    """Whether every time that friction holds the object at rest in a phase is proved to be possible.

    In closed loop the torque of a rest is taken to be linear within each step of the integrator.
    """
    motion = done.motion
    rows = jnp.arange(motion.at_rest.shape[0])
    rests = motion.at_rest & (rows < motion.count) & (jnp.diff(motion.phase_time) > MIN_REST)

    def all_proved():
        actuation = (
            schedule if isinstance(schedule, PhaseLoop) else restrict_to_phase(schedule, done.start, done.duration)
        )

        def next_rest(at):
            left, _ = at
            k = jnp.argmax(left)
            return left.at[k].set(False), _certify_interval(mechanics, dynamics, actuation, motion, k)

        return jax.lax.while_loop(lambda at: at[1] & at[0].any(), next_rest, (rests, jnp.asarray(True)))[1]

    return jax.lax.cond(rests.any(), all_proved, lambda: jnp.asarray(True))


def _certify_interval(
    mechanics: ScaledMechanics, dynamics: PathDynamics, actuation: Actuation, motion: Motion, k
) -> Bool[Array, ""]:
    """Whether one rest, step `k` of a motion, is."""
    segment, begin, end = (
        take_row(motion.segment, k),
        take_row(motion.phase_time, k),
        take_row(motion.phase_time, k + 1),
    )
    panel, xi = locate_panel(dynamics, segment, take_row(motion.s, k))
    z, x = (
        evaluate(values, panel, xi) / mechanics.configuration_unit
        for values in (dynamics.configuration, dynamics.velocity)
    )
    friction = mechanics.contacts.friction
    sliding = -take_row(dynamics.friction_ratio, segment) / jnp.where(
        friction > 0, friction, 1.0
    )  # signs of slip, as traced
    torques = (
        torques_of_step(actuation, motion, k)
        if isinstance(actuation, PhaseLoop)
        else _rest_torques(actuation, begin, end)
    )
    corners = torques / mechanics.torque_unit
    still, is_away = jnp.zeros_like(x), mechanics.contacts.is_away

    def move(share, torque):
        """Return the acceleration, and whether all forces are within their cones."""
        matrix, right = equations_of_motion(mechanics, z, x, still, share * sliding, share * jnp.sign(x[3:]))
        applied = right[:, 0] + fused_matmul(right[:, 3:5], torque)
        acceleration, *forces = fused_matmul(inverse_and_determinant(matrix)[0], applied)
        forces = jnp.stack(forces)
        if is_away is not None:  # what holds a finger that is away is no contact's force
            forces = jnp.where(is_away, forces[0], forces)
        return acceleration, force_slack(dynamics, forces).min() >= 0

    return _is_proved(jax.vmap(move), corners)


def _is_proved(moves, torques: Float[Array, "corners 2"]) -> Bool[Array, ""]:
    """Halve the interval of shares for each torque until the forces at both its ends are within their cones.

    `moves(shares, torques)` are the accelerations, and whether the forces are.
    """

    def halve(state):
        count, low, high, _ = state
        share = (low[0] + high[0]) / 2
        acceleration, holds = moves(share, torques)
        low, high = (
            jax.tree.map(lambda new, old, chosen=chosen: jnp.where(chosen, new, old), (share, holds), end)
            for chosen, end in ((acceleration > 0, low), (acceleration <= 0, high))
        )
        return count + 1, low, high, state[-1] | (low[1] & high[1])

    def continues(state):
        return (state[0] < HALVINGS) & ~state[-1].all()

    all_of_it = jnp.ones_like(torques[:, 0])
    low, high = ((share, moves(share, torques)[1]) for share in (-all_of_it, all_of_it))
    return jax.lax.while_loop(continues, halve, (jnp.asarray(0), low, high, low[1] & high[1]))[-1].all()


def _rest_torques(phase_schedule: PhaseSchedule, begin, end) -> Float[Array, "corners 2"]:
    """Return torques whose convex hull holds all those of a rest."""
    # At a step the torque is that before it where a rest ends, and that behind it where one begins.
    near = TIME_ROUNDING * jnp.finfo(end.dtype).eps
    first, last = (
        (phase_schedule.phase_time <= begin + near).sum() - 1,
        (phase_schedule.phase_time < end - near).sum() - 1,
    )
    rows = (jnp.clip(row, phase_schedule.first, phase_schedule.last) for row in (first, last))
    ends = jnp.stack([torque_at(phase_schedule, row, at) for row, at in zip(rows, (begin, end), strict=True)])
    inside = (phase_schedule.phase_time > begin + near) & (phase_schedule.phase_time < end - near)
    return jnp.concatenate([ends, jnp.where(inside[:, None], phase_schedule.values, ends[0])])
