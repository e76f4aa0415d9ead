"""What the stability sweep reads of a simulated scene: its tables along the path, at times, and within steps."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin import contact_force
from wholearm_jax.model import TorqueSchedule, torque_at
from wholearm_jax.simulation import DenseOutput, Motion, evaluate_dense, path_acceleration
from wholearm_jax.tracing import ContactPath

PLACES = np.concatenate([[0.0], (np.arange(30) + 0.5) / 30 + 0.01 * np.sin(np.arange(30.0)), [1.0]])
TIMES = (np.arange(9) + 0.5) / 9
GAUSS = np.polynomial.legendre.leggauss(4)


class Followed(NamedTuple):
    """What became of a scene's phase, and its tables read along the path, at times, and within steps (SI units)."""

    torque: TorqueSchedule
    status: Float[Array, ""]
    moving_status: Float[Array, ""]
    margin: Float[Array, ""]
    margin_share: Float[Array, ""]
    loss_time: Float[Array, ""]
    loss_contact: Float[Array, ""]
    ended: Float[Array, ""]
    phase_time: Float[Array, ""]
    s: Float[Array, ""]
    length: Float[Array, ""]
    w: Float[Array, ""]
    count: Float[Array, ""]
    rest: Float[Array, ""]
    departs: Float[Array, ""]
    moved: Float[Array, ""]
    along: dict
    at: dict
    ends: dict
    seam: Float[Array, ""]
    within: dict
    grain: Float[Array, ""]
    finite: Float[Array, ""]


class Readings(eqx.Module):
    """A simulated scene, to read its tables anywhere (SI units)."""

    path: ContactPath
    dynamics: PathDynamics
    schedule: TorqueSchedule
    duration: Float[Array, ""]
    motion: Motion
    steps: DenseOutput

    @property
    def last(self):
        """The number of the last step."""
        return jnp.maximum(self.motion.count - 1, 0)

    def read(self, segment, s):
        """Configuration, its first two derivatives and the signs at a place of a segment."""
        dynamics = self.dynamics
        panel, xi = locate_panel(dynamics, segment, s)

        def velocity(s):
            panel, xi = locate_panel(dynamics, segment, s)
            return evaluate(dynamics.velocity, panel, xi)

        x, bend = jax.jvp(velocity, (s,), (jnp.ones_like(s),))
        z = evaluate(dynamics.configuration, panel, xi)
        signs = {"slip": self.path.slip_sign[segment], "joint": self.path.joint_sign[segment]}
        return {"z": z, "x": x, "bend": bend} | signs

    def place(self, share):
        """The tables at a share of the path."""
        dynamics = self.dynamics
        s = dynamics.breakpoints[0] + dynamics.length * share
        segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
        panel, xi = locate_panel(dynamics, segment, s)
        tables = {
            "acceleration": evaluate(dynamics.acceleration, panel, xi),
            "force": evaluate(dynamics.force, panel, xi),
        }
        return self.read(segment, s) | tables | {"chart": self.path.chart[segment]}

    def state(self, step, xi):
        """The motion at a share of a step."""
        arc = jax.tree.map(lambda a: a[step], self.steps)
        share, s, w = evaluate_dense(arc, xi)
        at = (self.dynamics, self.schedule, self.duration, arc.segment, arc.row, share, s, w)
        motion = {"v": w / self.duration, "a": path_acceleration(*at) / self.duration**2, "share": share}
        motion |= {"torque": torque_at(self.schedule, arc.row, share), "force": contact_force(*at)}
        motion |= {"parts": self.magnitudes(arc, share, s, motion["v"])}
        return self.read(arc.segment, s) | motion | {"held": arc.at_rest | ~arc.live}

    def magnitudes(self, arc, share, s, v):
        """What each force is the sum of, in magnitude: against that its table is exact."""
        panel, xi = locate_panel(self.dynamics, arc.segment, s)
        torque = torque_at(self.schedule, arc.row, share)
        terms = jnp.concatenate([jnp.stack([jnp.ones_like(v), v**2, v]), torque])
        return jnp.abs(evaluate(self.dynamics.force, panel, xi)) @ jnp.abs(terms)

    def moment(self, share):
        """The motion at a share of the duration."""
        times = self.motion.phase_time
        step = jnp.clip((share >= times).sum() - 1, 0, self.last)
        width = times[step + 1] - times[step]
        xi = (share - times[step]) / jnp.where(width > 0, width, 1.0)
        return self.state(step, jnp.clip(xi, 0.0, 1.0))

    def node(self, k):
        """Place and speed before step `k`."""
        step = jnp.where(k == 0, 0, self.last)
        entered = self.motion.w_begin[0]
        fields = self.read(self.motion.segment[step], self.motion.s[k])
        return fields | {"v": jnp.where(k == 0, entered, self.motion.w[k]) / self.duration}

    def seam(self, k, unit):
        """How far `z` and `z_dot` jump where piece `k` meets the next one."""
        here, there = (self.read(segment, self.dynamics.breakpoints[k + 1]) for segment in (k, k + 1))
        jumps = jnp.stack([there["z"] - here["z"], there["x"] * self.dynamics.speed_ratio[k + 1] - here["x"]]) / unit
        return jnp.where(k + 1 < self.dynamics.count, jnp.abs(jumps).max(), 0.0)

    def within(self, count):
        """The motion at Gauss's points of all steps, and the steps' widths [s]."""
        nodes, times = jnp.arange(count), self.motion.phase_time
        xi = jnp.asarray((GAUSS[0] + 1) / 2, times.dtype)
        width = jnp.where(nodes < self.motion.count, times[1:] - times[:-1], 0.0) * self.duration
        return jax.vmap(jax.vmap(self.state, (None, 0)), (0, None))(nodes, xi) | {"width": width}

    def grain(self):
        """Rounding of what is differentiated in the panels of a piece, as short as pieces may be."""
        dynamics, segment = self.dynamics, self.motion.segment
        extent = dynamics.breakpoints[segment + 1] - dynamics.breakpoints[segment]
        eps = jnp.finfo(extent.dtype).eps
        fine = eps * dynamics.panels[segment] / jnp.where(extent > 0, extent, jnp.inf)
        return jnp.where(self.steps.live & ~self.motion.at_rest, fine, 0.0).max()

    def finite(self):
        """Whether all numbers are there."""
        dynamics, motion = self.dynamics, self.motion
        tables = (dynamics.acceleration, dynamics.force, dynamics.configuration, dynamics.velocity)
        parts = (*tables, motion.s, motion.w, motion.phase_time)
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in parts]))
