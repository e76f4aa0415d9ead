"""The departure of an object that friction holds at rest.

It starts forward when the acceleration with forward signs of friction is positive, backward when the one with backward
signs is negative, and stays when neither is. Both at once is ambiguous (Painleve). Derivation: section 4 of
`docs/derivation.md`.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from wholearm_jax.core import Status, fused_matmul
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.model import PhaseSchedule, torque_at

REST_ROUNDING = 1e-12  # of the terms of an acceleration, up to which it counts as none


def first_departure(
    dynamics: PathDynamics, phase_schedule: PhaseSchedule, segment, s, phase_time
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Find when an object at rest at `s` starts to move.

    The accelerations at rest are linear in the torque, hence piecewise linear in time: their first signs are exact, but
    for rounding, which would move an object that nothing holds and that torques balance.

    Returns:
        The phase time (1 if it stays), and a `Status`: `ok` (forward), `reversed`, `ambiguous` or `stuck` (it stays).
    """
    # Tabulate the torque on every interval of the schedule that is left.
    panel, xi = locate_panel(dynamics, segment, s)
    forward_terms = evaluate(dynamics.acceleration, panel, xi)[jnp.array([0, 3, 4])]
    backward_terms = -evaluate(dynamics.reverse_acceleration, panel, xi)
    rows = jnp.arange(phase_schedule.slope.shape[0])
    begin = jnp.maximum(phase_schedule.phase_time[:-1], phase_time)
    end = jnp.minimum(phase_schedule.phase_time[1:], 1.0)
    is_left = (rows >= phase_schedule.first) & (rows <= phase_schedule.last) & (end >= begin)
    # A start so near the end of an interval belongs to the next one: no step fits in between.
    last_start = end - 8 * jnp.finfo(end.dtype).eps
    torque = jax.vmap(torque_at, (None, 0, 0))(phase_schedule, rows, begin)

    def first_positive(terms):
        """The time at which an acceleration, linear in `(1, tau1, tau2)`, first turns positive."""
        size = jnp.abs(terms[0]) + jnp.abs(torque) @ jnp.abs(terms[1:])
        value = terms[0] + fused_matmul(torque, terms[1:]) - REST_ROUNDING * stop_gradient(size)
        rate = fused_matmul(phase_schedule.slope, terms[1:])
        root = begin - value / jnp.where(rate > 0, rate, 1.0)
        time = jnp.where(value > 0, begin, jnp.where((rate > 0) & (root < last_start), root, jnp.inf))
        time = jnp.where(is_left, time, jnp.inf)
        return time[jnp.argmin(stop_gradient(time))]

    # Compare the first starts forward and backward.
    forward, backward = first_positive(forward_terms), first_positive(backward_terms)
    both = (forward == backward) & jnp.isfinite(forward)
    status = jnp.select(
        [both, forward < backward, backward < forward],
        [int(Status.AMBIGUOUS), int(Status.OK), int(Status.REVERSED)],
        int(Status.STUCK),
    )
    time = jnp.minimum(forward, backward)
    return jnp.where(jnp.isfinite(time), jnp.where(jnp.isfinite(time), time, 0.0), 1.0), status
