"""Judge: what became of a simulated phase, from its motion and its score."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from wholearm_jax.core import Status
from wholearm_jax.dynamics import Impact, PathDynamics
from wholearm_jax.margin import MarginResult, force_slack
from wholearm_jax.simulation import Motion

DEFAULT_ARRIVAL = 1e-6  # of the wire's length: how near its end a phase that arrives at rest must come
ARRIVAL_SPEED_FACTOR = 12.0
"""The speed left at arrival within a share `a` of the wire is at most `sqrt(BRAKING a)` wire lengths a duration: what
braking at 6 lengths a duration squared (the even rest-to-rest motion) ends within `a` of a length. Nearer to the end
time and position do not fix the speed better than this square root."""

GOALS = {"moving": 0, "caught": 0, "rest": 1, "hold": 2}
"""How a phase must end, as a number that compiled programs take: at any speed, at rest, where it began."""

IMPULSE_ROUNDING = 1e-9  # share of `Impact.size` by which an impulse may be negative for rounding


class Assessment(NamedTuple):
    """A phase's `status`, when as a share of its duration, and the contact concerned (-1: none)."""

    status: Int[Array, ""]
    phase_time: Float[Array, ""]
    contact: Int[Array, ""]


def assess_phase(
    dynamics: PathDynamics,
    motion: Motion,
    margin_result: MarginResult,
    goal: Int[Array, ""],
    entered: Impact,
    arrival: float | Float[Array, ""] = DEFAULT_ARRIVAL,
) -> Assessment:
    """Decide the status of a phase that must end as `goal` says (one of `GOALS`), within a share `arrival` of its
    wire's length.

    The earliest trouble counts: a wire that cannot be traced, an impulse that would pull (or throw the object back)
    where the phase is entered with speed, a tensile force, then how the motion ended. A phase that holds the object
    fails when it departs: `reversed` backward, `not_reached` forward along the way that its wire was traced.
    """
    at_rest, holds = goal == GOALS["rest"], goal == GOALS["hold"]
    phase_time, s, w = (values[motion.count] for values in (motion.phase_time, motion.s, motion.w))
    speed = jnp.sqrt(ARRIVAL_SPEED_FACTOR * jnp.asarray(arrival, s.dtype))
    near = jnp.abs(dynamics.breakpoints[-1] - s) <= arrival * dynamics.length
    slow = w <= speed * dynamics.length
    late = phase_time >= 1 - speed
    ended = motion.status
    there = (ended == Status.LEFT_FORMATION) | (ended == Status.OK)
    held = (ended == Status.STUCK) | ((ended == Status.REVERSED) & late)
    arrived = near & (there | held) & (slow | ~at_rest)
    finish = jnp.where(arrived, int(Status.OK), jnp.where(ended == Status.OK, int(Status.NOT_REACHED), ended))
    stayed = motion.at_rest[0] & (motion.phase_time[1] >= 1)
    departs = jnp.where(motion.at_rest[0], motion.phase_time[1], 0.0)
    moved = (ended == Status.REVERSED) | (ended == Status.AMBIGUOUS)
    kept = jnp.where(stayed, int(Status.OK), jnp.where(moved & (phase_time <= departs), ended, int(Status.NOT_REACHED)))
    finish, phase_time = jnp.where(holds, kept, finish), jnp.where(holds, departs, phase_time)
    lost = jnp.isfinite(margin_result.loss_time) & ~holds
    status = jnp.where(lost, int(Status.CONTACT_LOST), finish)
    traced = dynamics.status == 0
    room = force_slack(dynamics, entered.impulse)  # impulses have the cones of forces
    pulls = room.min() < -IMPULSE_ROUNDING * entered.size
    back = entered.speed < 0
    refused = pulls | back
    early = jnp.where(pulls, int(Status.CONTACT_LOST), int(Status.REVERSED))
    contact = jnp.where(pulls, jnp.argmin(room), jnp.where(lost & ~back, margin_result.loss_contact, -1))
    return Assessment(
        status=jnp.where(traced, jnp.where(refused, early, status), dynamics.status),
        phase_time=jnp.where(traced & ~refused, jnp.where(lost, margin_result.loss_time, phase_time), 0.0),
        contact=jnp.where(traced, contact, -1),
    )
