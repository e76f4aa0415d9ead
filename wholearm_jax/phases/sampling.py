"""Trajectories: a simulated plan sampled in time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import CachedJit, Status, on_host, require_positive
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin import contact_force
from wholearm_jax.model import Arrival, TorqueSchedule, interval, pad_schedule, restrict_to_phase, round_up, torque_at
from wholearm_jax.phases.result import Result
from wholearm_jax.simulation import Motion, dense_output, evaluate_dense

DEFAULT_SAMPLES = 1024  # samples of a phase that one call computes: numbers of samples that differ share a program


class Trajectory(NamedTuple):
    """A phase sampled in time, SI units; `cn` and `ct` are NaN while friction holds the object at rest.

    Their columns are the formation's contacts in order; those it has fewer than four are NaN.
    """

    time: Float[Array, "samples"]
    s: Float[Array, "samples"]
    z: Float[Array, "samples 5"]
    z_dot: Float[Array, "samples 5"]
    torque: Float[Array, "samples 2"]
    cn: Float[Array, "samples contacts"]
    ct: Float[Array, "samples contacts"]


def by_contact(dynamics: PathDynamics, segment, forces: Float[Array, "rows"]):
    """`c_n` and `c_t` of every contact from the forces in the constraints; NaN beyond the last contact."""
    rolls = jnp.roll(dynamics.tangential, -1)
    tangential = jnp.where(rolls, jnp.roll(forces, -1), forces * dynamics.friction_ratio[segment])
    (slot,) = jnp.nonzero(~dynamics.tangential, size=forces.shape[0], fill_value=-1)
    return tuple(jnp.where(slot >= 0, values[slot], jnp.nan) for values in (forces, tangential))


@CachedJit
def sample_phase(
    dynamics: PathDynamics, schedule: TorqueSchedule, start, duration, motion: Motion, phase_times
) -> Trajectory:
    """A phase's motion at given shares of its duration; beyond its end the object rests there."""
    phase_schedule = restrict_to_phase(schedule, start, duration)
    steps = dense_output(dynamics, phase_schedule, duration, motion)
    rows = jnp.arange(steps.live.shape[0])

    def one(phase_time):
        k = jnp.where(steps.live & (phase_time >= motion.phase_time[:-1]), rows, 0).max()
        arc = jax.tree.map(lambda a: a[k], steps)
        width = arc.phase_time[1] - arc.phase_time[0]
        xi = jnp.clip((phase_time - arc.phase_time[0]) / jnp.where(width > 0, width, 1.0), 0.0, 1.0)
        _, s, w = evaluate_dense(arc, xi)
        over = phase_time > motion.phase_time[motion.count] + 1e-12
        w = jnp.where(over, 0.0, w)
        panel, at = locate_panel(dynamics, arc.segment, s)
        forces = contact_force(dynamics, phase_schedule, duration, arc.segment, arc.row, phase_time, s, w)
        cn, ct = by_contact(dynamics, arc.segment, jnp.where(arc.at_rest | over, jnp.nan, forces))
        tau = torque_at(
            phase_schedule, interval(phase_schedule, phase_time), phase_time
        )  # a wait is one step over many intervals
        z_dot = evaluate(dynamics.velocity, panel, at) * w / duration
        return s, evaluate(dynamics.configuration, panel, at), z_dot, tau, cn, ct

    return Trajectory(start + duration * phase_times, *jax.vmap(one)(phase_times))


def _of_contacts(forces: np.ndarray, count: int) -> np.ndarray:
    """Return the forces with NaN behind the last of `count` contacts."""
    return np.where(np.arange(forces.shape[1]) < count, forces, np.nan)


@on_host("sample outside of the transformation")
def trajectory(result: Result, samples: int = 201) -> tuple[Trajectory, ...]:
    """Every phase at `samples` evenly spaced times; a phase that failed stops there, and later ones are left out.

    A tuple of `Trajectory`, one a phase: `time` `(samples,)` [s], `z` and `z_dot` `(samples, 5)`, `cn` and `ct`
    `(samples, 4)` [N]. Raises ValueError for fewer than one.

    >>> scene = wa.load("heptagon")
    >>> first, *_ = wa.trajectory(wa.simulate(scene, wa.quasistatic(scene)), samples=5)
    >>> [f"{t:.2f}" for t in first.time.tolist()], first.cn.shape
    (['0.00', '0.25', '0.50', '0.75', '1.00'], (5, 4))
    """
    require_positive(samples=samples)
    found, schedule, rows = [], pad_schedule(result.torque), round_up(samples, DEFAULT_SAMPLES)
    for phase in result.phases:
        if int(phase.traced.dynamics.status) != Status.OK:
            break
        left = phase.arrive is Arrival.MOVING or phase.status is not Status.OK
        stop = (phase.time - phase.start) / phase.duration if left else 1.0
        phase_times = np.full(rows, stop)
        phase_times[:samples] = np.linspace(0.0, stop, samples)
        outcome = phase.outcome
        course = sample_phase(
            phase.traced.dynamics, schedule, outcome.start, outcome.duration, outcome.motion, phase_times
        )
        course = jax.tree.map(lambda a: a[:samples], jax.device_get(course))
        cn, ct = (_of_contacts(forces, len(phase.contacts)) for forces in (course.cn, course.ct))
        found.append(course._replace(cn=cn, ct=ct))
        if phase.status is not Status.OK:
            break
    return tuple(found)
