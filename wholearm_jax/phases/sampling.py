"""Trajectories: a simulated plan sampled in time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core.programs import Program
from wholearm_jax.core.status import Status
from wholearm_jax.core.validation import require_positive
from wholearm_jax.dynamics.path_dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin.contact_forces import dense_output, contact_force, evaluate_dense
from wholearm_jax.model.schedule import TorqueSchedule, interval, pad_schedule, round_up, torque_at, restrict_to_phase
from wholearm_jax.phases.result import Result
from wholearm_jax.simulation.phase_motion import Motion

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


def by_contact(table: PathDynamics, piece, forces: Float[Array, "slots"]):
    """`c_n` and `c_t` of every contact from the forces in the constraints; NaN beyond the last contact."""
    rolls = jnp.roll(table.tangential, -1)
    tangential = jnp.where(rolls, jnp.roll(forces, -1), forces * table.tension[piece])
    (slot,) = jnp.nonzero(~table.tangential, size=forces.shape[0], fill_value=-1)
    return tuple(jnp.where(slot >= 0, values[slot], jnp.nan) for values in (forces, tangential))


@Program
def sample_phase(table: PathDynamics, schedule: TorqueSchedule, start, duration, motion: Motion, shares) -> Trajectory:
    """A phase's motion at given shares of its duration; beyond its end the object rests there."""
    seen = restrict_to_phase(schedule, start, duration)
    steps = dense_output(table, seen, duration, motion)
    rows = jnp.arange(steps.live.shape[0])

    def one(share):
        k = jnp.where(steps.live & (share >= motion.share[:-1]), rows, 0).max()
        arc = jax.tree.map(lambda a: a[k], steps)
        width = arc.share[1] - arc.share[0]
        xi = jnp.clip((share - arc.share[0]) / jnp.where(width > 0, width, 1.0), 0.0, 1.0)
        _, s, w = evaluate_dense(arc, xi)
        over = share > motion.share[motion.count] + 1e-12
        w = jnp.where(over, 0.0, w)
        panel, at = locate_panel(table, arc.piece, s)
        forces = contact_force(table, seen, duration, arc.piece, arc.row, share, s, w)
        cn, ct = by_contact(table, arc.piece, jnp.where(arc.held | over, jnp.nan, forces))
        tau = torque_at(seen, interval(seen, share), share)  # a wait is one step over many intervals
        z_dot = evaluate(table.velocity, panel, at) * w / duration
        return s, evaluate(table.configuration, panel, at), z_dot, tau, cn, ct

    return Trajectory(start + duration * shares, *jax.vmap(one)(shares))


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
        if int(phase.traced.table.status) != Status.OK:
            break
        left = phase.arrive == "moving" or phase.status is not Status.OK
        stop = (phase.time - phase.start) / phase.duration if left else 1.0
        shares = np.full(rows, stop)
        shares[:samples] = np.linspace(0.0, stop, samples)
        outcome = phase.outcome
        course = sample_phase(phase.traced.table, schedule, outcome.start, outcome.duration, outcome.motion, shares)
        found.append(jax.tree.map(lambda a: a[:samples], jax.device_get(course)))
        if phase.status is not Status.OK:
            break
    return tuple(found)
