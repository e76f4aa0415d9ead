"""The motion along a path as an ordinary differential equation, and one step of a solver.

Phase time `u` is time over the duration `T` of the phase, and `w = v T` the speed in `s` per duration, so that steps
and tolerances mean the same for every size and duration:

    ds/du = w,    dw/du = T^2 (A0 + A3 tau1 + A4 tau2) + T A2 w + A1 w^2

with the coefficients `PathDynamics.acceleration`. In closed loop the memory of the law joins the state
(`closed_loop`). Within a segment of the path and an interval of the torque schedule the right-hand side is
smooth. Derivation: section 6 of `docs/derivation.md`.
"""

from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wholearm_jax.dynamics import PathDynamics, evaluate_dot, locate_panel
from wholearm_jax.simulation.closed_loop import Actuation, PhaseLoop, memory_rate, torque_of
from wholearm_jax.simulation.integrator_options import IntegratorOptions, differentiable_solver


class PathODE(NamedTuple):
    """What the equation depends on."""

    dynamics: PathDynamics
    phase_schedule: Actuation
    duration: Float[Array, ""]  # of the phase, or of the part of it that is one unit of phase time [s]


@jax.jit
def path_acceleration(
    dynamics: PathDynamics, phase_schedule: Actuation, duration, segment, row, phase_time, s, w, memory=None
) -> Float[Array, ""]:
    """Evaluate `dw/du` for forward travel, in a segment and an interval `row` of the schedule.

    `memory` is what a closed-loop law remembers.
    """
    panel, xi = locate_panel(dynamics, segment, s)
    terms = jnp.stack([duration**2, w**2, duration * w])
    terms = jnp.concatenate([terms, duration**2 * torque_of(phase_schedule, row, phase_time, memory)])
    return evaluate_dot(dynamics.acceleration, panel, xi, terms)


def state_rate(ode: PathODE, segment, row, phase_time, y) -> Float[Array, "state"]:
    """Evaluate `dy/du` at the state `y = (s, w)` or, in closed loop, `(s, w, *memory)`."""
    dynamics, actuation, duration = ode
    if isinstance(actuation, PhaseLoop):
        acceleration = path_acceleration(*ode, segment, row, phase_time, y[0], y[1], y[2:])
        remembered = memory_rate(actuation, dynamics, duration, segment, row, phase_time, y[0], y[2:])
        return jnp.concatenate([jnp.stack([y[1], acceleration]), remembered])
    return jnp.stack([y[1], path_acceleration(*ode, segment, row, phase_time, y[0], y[1])])


@jax.jit
def solver_step(
    dynamics, phase_schedule, duration, options: IntegratorOptions, segment, row, phase_time, y, length
) -> Float[Array, "state"]:
    """Take one step of the solver of a given length from a state (`state_rate`), in a segment and an interval."""
    solver = differentiable_solver(options)

    def field(u, y, args):
        return state_rate(args, segment, row, u, y)

    term, args = dfx.ODETerm(field), PathODE(dynamics, phase_schedule, duration)
    state = solver.init(term, phase_time, phase_time + length, y, args)
    return solver.step(term, phase_time, phase_time + length, y, args, state, made_jump=True)[0]


def join_state(s, w, memory) -> Float[Array, "state"]:
    """Join `s`, `w` and the memory of a closed-loop law (None: open loop)."""
    return jnp.stack([s, w]) if memory is None else jnp.concatenate([jnp.stack([s, w]), memory])


def split_state(y: Float[Array, "state"]):
    """Split a state into `s`, `w` and the memory of a closed-loop law (None: open loop)."""
    return y[0], y[1], y[2:] if y.shape[0] > 2 else None
