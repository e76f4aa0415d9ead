r"""Rest: a proof that friction can hold an object that stands still, without a linear programme.

Of an object that friction keeps at rest the forces are not determined (`holding`). But two sets of them are known,
those of setting out forward and backward: accelerations `a+ <= 0 <= a-` and forces `c+`, `c-`, linear in the torque.
The mean of both in which the accelerations cancel balances, and its friction is within every cone if that of `c+` and
`c-` is. Where it is not, the rest may still be possible: that is for the linear programme to say.

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
    terms = jnp.concatenate([jnp.ones_like(corners[:, :1]), corners], axis=1)

    def within(sign):
        matrix, right = equations_of_motion(mechanics, z, x, jnp.zeros_like(x), sign * sliding, sign * jnp.sign(x[3:]))
        solved = fused_matmul(inverse_and_determinant(matrix)[0], right[:, jnp.array([0, 3, 4])])[1:]
        is_away = mechanics.contacts.is_away
        if is_away is not None:  # what holds a finger that is away is no contact's force
            solved = jnp.where(is_away[:, None], solved[:1], solved)
        return jax.vmap(lambda one: force_slack(dynamics, fused_matmul(solved, one)))(terms).min() >= 0

    return jax.lax.map(within, jnp.array([1.0, -1.0])).all()


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
