"""Landings: the last step of a stage, taken again with the length that ends exactly where the stage does.

Derivation: section 6 of `docs/derivation.md`.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from wholearm_jax.core import eps_power
from wholearm_jax.dynamics import PathDynamics, evaluate_dot, locate_panel
from wholearm_jax.model import PhaseSchedule, torque_at
from wholearm_jax.simulation.integrator import IntegratorOptions, solver_of

MAX_EVENT_ITERATIONS = 40  # at most so many Newton steps, or halvings, to the place where a stage ends


@jax.jit
def path_acceleration(dynamics: PathDynamics, phase_schedule: PhaseSchedule, duration, segment, row, phase_time, s, w):
    """`dw/du` for forward travel in a piece and a torque interval."""
    panel, xi = locate_panel(dynamics, segment, s)
    rest = jnp.stack([duration**2, w**2, duration * w])
    terms = jnp.concatenate([rest, duration**2 * torque_at(phase_schedule, row, phase_time)])
    return evaluate_dot(dynamics.acceleration, panel, xi, terms)


@jax.jit
def solver_step(dynamics, phase_schedule, duration, options: IntegratorOptions, segment, row, phase_time, y, length):
    """One step of the solver from `y = (s, w)` at a share of the phase, within a piece and a torque interval."""
    solver = solver_of(options)

    def field(u, y, args):
        dynamics, phase_schedule, duration = args
        return jnp.stack([y[1], path_acceleration(dynamics, phase_schedule, duration, segment, row, u, y[0], y[1])])

    term, args = dfx.ODETerm(field), (dynamics, phase_schedule, duration)
    state = solver.init(term, phase_time, phase_time + length, y, args)
    return solver.step(term, phase_time, phase_time + length, y, args, state, made_jump=True)[0]


def step_to_event(dynamics, phase_schedule, duration, options, segment, row, node, end, s_stop, w_stop, wanted):
    """Retake the last step from `node` with the length that lands on `s = goal` or on `w = 0`, whichever comes first.

    Returns where it lands, whether on the goal, and whether it went astray: no length within the step lands there.
    """
    phase_time, s, w = node
    longest = jnp.where(wanted, end - phase_time, 0.0)

    def field(phase_time, y, args):
        dynamics, phase_schedule, duration = args
        return jnp.stack(
            [y[1], path_acceleration(dynamics, phase_schedule, duration, segment, row, phase_time, y[0], y[1])]
        )

    def step(phase_time, length, y, args):
        dynamics, phase_schedule, duration = args
        return solver_step(dynamics, phase_schedule, duration, options, segment, row, phase_time, y, length)

    args = (dynamics, phase_schedule, duration)
    fixed = stop_gradient((phase_time, jnp.stack([s, w]), args, longest))
    goal_now = stop_gradient(s_stop)

    def beyond(y):
        """Whether the goal is passed by more than the speed has fallen below rest, and by how much."""
        passing, resting = y[0] - goal_now, w_stop - y[1]
        return passing >= resting, jnp.maximum(passing, resting)

    def narrow(bracket):
        """Newton on the step's length, bisecting where it would leave the bracket."""
        low, high, length, _, count = bracket
        y = step(fixed[0], length, fixed[1], fixed[2])
        passed, miss = beyond(y)
        rate = field(fixed[0] + length, y, fixed[2])
        rate = jnp.where(passed, rate[0], -rate[1])
        low, high = jnp.where(miss < 0, length, low), jnp.where(miss < 0, high, length)
        guess = length - miss / jnp.where(rate == 0, 1.0, rate)
        better = jnp.where((guess >= low) & (guess <= high), guess, (low + high) / 2)
        return low, high, better, jnp.abs(better - length), count + 1

    def going(bracket):
        *_, moved, count = bracket
        return (moved > enough) & (count < MAX_EVENT_ITERATIONS)

    # Half of the digits and some: the last step below, which carries derivatives, brings the others.
    enough = eps_power(s, 5 / 8) * fixed[3]
    begin = (jnp.zeros_like(fixed[3]), fixed[3], fixed[3] / 2, fixed[3], jnp.asarray(0, int))
    length = jax.lax.while_loop(going, narrow, begin)[2]
    y = step(phase_time, length, jnp.stack([s, w]), args)
    rate = stop_gradient(field(phase_time + length, y, args))
    # An object that comes to rest just at the goal does both: it lands on the one that is nearer in time.
    targets = jnp.stack([jnp.where(jnp.isfinite(s_stop), s_stop, 0.0), jnp.zeros_like(s_stop)])
    lates = (targets - y) / jnp.where(wanted & (rate != 0), rate, 1.0)
    possible = jnp.stack([jnp.isfinite(s_stop) & (rate[0] > 0), jnp.isfinite(w_stop) & (rate[1] < 0)])
    which = jnp.argmin(jnp.where(possible, jnp.abs(stop_gradient(lates)), jnp.inf))
    passed = wanted & (which == 0)
    late = jnp.where(wanted, lates[which], 0.0)
    failed = wanted & ~(jnp.abs(late) <= longest)
    late = jnp.where(failed, 0.0, late)
    y = y + rate * late
    return (
        phase_time + length + late,
        jnp.where(passed, targets[0], y[0]),
        jnp.where(passed, y[1], 0.0),
        passed,
        failed,
    )
