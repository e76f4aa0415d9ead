"""Assessment of a simulated phase: its status, from its motion and its margin."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status
from wholearm_jax.dynamics import Impact, PathDynamics
from wholearm_jax.margin import MarginResult
from wholearm_jax.model import Arrival
from wholearm_jax.phases.contact_opening import MAX_OPENING, ContactOpening
from wholearm_jax.simulation import Motion

DEFAULT_ARRIVAL = 1e-6  # distance from its path's end, in path lengths, within which a phase must end
ARRIVAL_SPEED_FACTOR = 12.0
"""Speed allowed at arrival: within a distance `a` of the end, in path lengths, it is at most `sqrt(12 a)` path lengths
per duration, from which braking at 6 lengths per duration squared (the uniform rest-to-rest motion) stops within `a`.
Nearer to the end, time and position do not fix the speed better than this square root. A motion that brakes harder than
so in its last step may be as fast as its own braking allows, up to `BRAKING_SPEED`."""
BRAKING_SPEED = 0.1  # path lengths per duration


class Assessment(NamedTuple):
    """Status of a phase, and the time and contact of its end or failure."""

    status: Int[Array, ""]
    phase_time: Float[Array, ""]  # fraction of the duration
    contact: Int[Array, ""]  # constraint row; -1: none


def assess_phase(
    dynamics: PathDynamics,
    motion: Motion,
    margin_result: MarginResult,
    goal: Arrival | Int[Array, ""],
    impact: Impact,
    opening: ContactOpening,
    arrival: float | Float[Array | np.ndarray, ""] = DEFAULT_ARRIVAL,
    is_slow: Bool[Array, ""] | None = None,
) -> Assessment:
    """Decide the status of a phase from the earliest trouble.

    In order of precedence: a path that cannot be traced, an impulse at entry that opens a contact by more than
    `MAX_OPENING` or throws the object back, a tensile force, then how the motion ended; a path that ends at an obstacle
    of the hand is not ok. A phase that holds the object fails when it departs: `reversed` backward, `not_reached`
    forward in the direction in which its path was traced.

    Args:
        dynamics: Tabulated path dynamics.
        motion: Simulated motion.
        margin_result: Margin of the motion, with the first loss of contact.
        goal: How the phase must end, an `Arrival`.
        impact: Impact at which the phase is entered.
        opening: How far a contact opens then.
        arrival: Distance from the path's end within which the phase must end, in path lengths.
        is_slow: Whether the motion ends slowly enough for a rest (None: by `ARRIVAL_SPEED_FACTOR` and its braking).
    """
    holds = goal == Arrival.HOLD
    contact_lost, end_time = int(Status.CONTACT_LOST), motion.phase_time[motion.count]
    is_lost = jnp.isfinite(margin_result.loss_time) & ~holds
    hold_status, departure_time = _assess_hold(motion)
    arrival_status = _assess_arrival(dynamics, motion, goal == Arrival.AT_REST, arrival, is_slow)
    rows = (  # condition, status, phase time, contact
        (dynamics.status != int(Status.OK), dynamics.status, 0.0, -1),
        (opening.height > MAX_OPENING, contact_lost, 0.0, opening.contact),
        (impact.speed < 0, int(Status.REVERSED), 0.0, -1),
        (is_lost, contact_lost, margin_result.loss_time, margin_result.loss_contact),
        (holds, hold_status, departure_time, -1),
    )
    conditions, statuses, times, contacts = zip(*rows, strict=True)
    return Assessment(
        status=jnp.select(conditions, statuses, arrival_status),
        phase_time=jnp.select(conditions, times, end_time),
        contact=jnp.select(conditions, contacts, -1),
    )


def _assess_arrival(dynamics: PathDynamics, motion: Motion, at_rest, arrival, is_slow) -> Int[Array, ""]:
    """Decide the status of a phase that moves the object to its path's end, `at_rest` or at any speed."""
    phase_time, s = motion.phase_time[motion.count], motion.s[motion.count]
    max_speed = jnp.sqrt(ARRIVAL_SPEED_FACTOR * jnp.asarray(arrival, s.dtype))
    is_near = jnp.abs(dynamics.breakpoints[-1] - s) <= arrival * dynamics.length
    if is_slow is None:
        braking_speed = _braking_speed(motion, arrival * dynamics.length, BRAKING_SPEED * dynamics.length)
        is_slow = motion.w[motion.count] <= jnp.maximum(max_speed * dynamics.length, braking_speed)
    is_late = phase_time >= 1 - max_speed
    ended = motion.status
    reached = (ended == Status.LEFT_FORMATION) | (ended == Status.OK)
    stopped = (ended == Status.STUCK) | ((ended == Status.REVERSED) & is_late)
    arrived = is_near & (reached | stopped) & (is_slow | ~at_rest)
    failure = jnp.where(ended == Status.OK, int(Status.NOT_REACHED), ended)
    arrival_status = jnp.where(dynamics.ends_at_obstacle, int(Status.OBSTACLE), int(Status.OK))
    return jnp.where(arrived, arrival_status, failure)


def _braking_speed(motion: Motion, distance, most) -> Float[Array, ""]:
    """Return the speed, at `most`, from which a motion that brakes as in its last step stops within a distance."""
    last = jnp.maximum(motion.count - 1, 0)
    time = motion.phase_time[motion.count] - motion.phase_time[last]
    braking = (motion.w_begin[last] - motion.w[motion.count]) / jnp.where(time > 0, time, jnp.inf)
    return jnp.minimum(jnp.sqrt(2 * jnp.maximum(braking, 0.0) * distance), most)


def _assess_hold(motion: Motion) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Decide the status of a phase that holds the object, and the time at which the object departs."""
    first_end = motion.phase_time[1]
    departure_time = jnp.where(motion.at_rest[0], first_end, 0.0)
    stayed = motion.at_rest[0] & (first_end >= 1)
    moved_back = (motion.status == Status.REVERSED) | (motion.status == Status.AMBIGUOUS)
    at_departure = moved_back & (motion.phase_time[motion.count] <= departure_time)
    failure = jnp.where(at_departure, motion.status, int(Status.NOT_REACHED))
    return jnp.where(stayed, int(Status.OK), failure), departure_time
