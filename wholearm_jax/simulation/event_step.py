"""Landings: the last step of a stage, taken again with the length that ends exactly where the stage does.

Derivation: section 6 of `docs/derivation.md`.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from wholearm_jax.core.arrays import eps_power
from wholearm_jax.dynamics.path_dynamics import PathDynamics, evaluate_dot, locate_panel
from wholearm_jax.model.schedule import PhaseSchedule, torque_at
from wholearm_jax.simulation.integrator import IntegratorOptions, solver_of

MAX_EVENT_ITERATIONS = 40  # at most so many Newton steps, or halvings, to the place where a stage ends


@jax.jit
def path_acceleration(table: PathDynamics, seen: PhaseSchedule, duration, piece, row, share, s, w):
    """`dw/du` for forward travel in a piece and a torque interval."""
    panel, xi = locate_panel(table, piece, s)
    rest = jnp.stack([duration**2, w**2, duration * w])
    terms = jnp.concatenate([rest, duration**2 * torque_at(seen, row, share)])
    return evaluate_dot(table.acceleration, panel, xi, terms)


@jax.jit
def solver_step(table, seen, duration, how: IntegratorOptions, piece, row, share, y, length):
    """One step of the solver from `y = (s, w)` at a share of the phase, within a piece and a torque interval."""
    solver = solver_of(how)

    def field(u, y, args):
        table, seen, duration = args
        return jnp.stack([y[1], path_acceleration(table, seen, duration, piece, row, u, y[0], y[1])])

    term, args = dfx.ODETerm(field), (table, seen, duration)
    state = solver.init(term, share, share + length, y, args)
    return solver.step(term, share, share + length, y, args, state, made_jump=True)[0]


def step_to_event(table, seen, duration, how, piece, row, node, end, goal, floor, wanted):
    """Retake the last step from `node` with the length that lands on `s = goal` or on `w = 0`, whichever comes first.

    Returns where it lands, whether on the goal, and whether it went astray: no length within the step lands there.
    """
    share, s, w = node
    longest = jnp.where(wanted, end - share, 0.0)

    def field(share, y, args):
        table, seen, duration = args
        return jnp.stack([y[1], path_acceleration(table, seen, duration, piece, row, share, y[0], y[1])])

    def step(share, length, y, args):
        table, seen, duration = args
        return solver_step(table, seen, duration, how, piece, row, share, y, length)

    args = (table, seen, duration)
    fixed = stop_gradient((share, jnp.stack([s, w]), args, longest))
    goal_now = stop_gradient(goal)

    def beyond(y):
        """Whether the goal is passed by more than the speed has fallen below rest, and by how much."""
        passing, resting = y[0] - goal_now, floor - y[1]
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
    y = step(share, length, jnp.stack([s, w]), args)
    rate = stop_gradient(field(share + length, y, args))
    # An object that comes to rest just at the goal does both: it lands on the one that is nearer in time.
    targets = jnp.stack([jnp.where(jnp.isfinite(goal), goal, 0.0), jnp.zeros_like(goal)])
    lates = (targets - y) / jnp.where(wanted & (rate != 0), rate, 1.0)
    possible = jnp.stack([jnp.isfinite(goal) & (rate[0] > 0), jnp.isfinite(floor) & (rate[1] < 0)])
    which = jnp.argmin(jnp.where(possible, jnp.abs(stop_gradient(lates)), jnp.inf))
    passed = wanted & (which == 0)
    late = jnp.where(wanted, lates[which], 0.0)
    astray = wanted & ~(jnp.abs(late) <= longest)
    late = jnp.where(astray, 0.0, late)
    y = y + rate * late
    return (
        share + length + late,
        jnp.where(passed, targets[0], y[0]),
        jnp.where(passed, y[1], 0.0),
        passed,
        astray,
    )
