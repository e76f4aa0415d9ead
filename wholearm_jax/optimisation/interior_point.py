r"""Descend: the torques of one phase, improved by gradient descent through the simulation of its intervals.

The variables `p` are those of `shooting`. With forces `c_i`, in units of the bound, and all other rooms `r_j` (within
the limits on torques, their rates, speeds and the duration), the loss at temperature `T` is minus the smooth margin

    max_m [ m + T sum_i w_i log(c_i - m) ] + T sum_j w_j log r_j

subject to the intervals joining and the last ending at rest at the wire's end, `e(p) = 0`. Its maximum lies less than
`T` times the sum of weights below the largest margin. The direction comes from Newton's method on the conditions of
that maximum, the products `slack * price = T w` being unknowns of their own (a primal-dual interior point); the
curvature of the simulation itself is left out (Gauss-Newton). It is an optax gradient transformation, and any other
optax optimiser may take its place (`projected`).

A step follows the curve on which accelerations and squeezes at the knots change evenly (`retract`): on it the intervals
are nearly linear. One that raises the loss, with a penalty on `|e|`, by more than a descent's `rise` is taken again
with a part of its length; and where limits leave only tiny steps, the temperature rises again, and stays above the one
at which that happened.
Source of the interior point and of the penalty: J. Nocedal and S. J. Wright, Numerical Optimization, 2006, chapters 18
and 19.

Derivation: section 9 of `docs/derivation.md`.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from wholearm_jax.core import Program
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import acceleration_terms, log_barrier_minimum
from wholearm_jax.optimisation.linearisation import (
    Limits,
    LinearisedProblem,
    jacobian_product,
    jacobian_transpose_product,
    linearise,
    of_states,
    slack_sizes,
)
from wholearm_jax.optimisation.multiple_shooting import Variables
from wholearm_jax.optimisation.riccati import kkt_step, project_step
from wholearm_jax.simulation import IntegratorOptions

MU_MAX, MU_MIN = 0.1, 1e-4  # temperatures, as shares of the bound
NEAR = 0.95  # share of the way to a limit that a step may go
LEAST = 0.05  # slack that a room starts with at least
LONGEST = (0.1, 0.5)  # most that `s` and `v` at a knot may change in a step [lengths, lengths a duration]
SHORTER = 0.25  # a step that leaves what can be simulated is taken again with this share of it
SMALL = 1e-3  # a share of a step that is taken whatever becomes of the merit
EDGE = 1e-3  # room below which the merit's logarithm goes on as its tangent
STALL_STEP = (
    0.02  # share of a step, below which limits count as leaving no way: the temperature rises `MU_INCREASE` times
)
MU_INCREASE = 3.0
MU_MIN_INCREASE, MU_MIN_MAX = 4.0, 0.01  # a jam at the coldest makes that so many times warmer, but no warmer than this
DEFECT_TOL = 1e-9  # sum of the defects below which the intervals count as joined


class InteriorPointState(NamedTuple):
    """The interior point's own unknowns: slack and price of every room, with the intervals that their parts were of
    (`interval_of_part`), the level `m` of the margin (NaN: not yet chosen), the temperature and the `coldest` that it
    may become,
    the shares of its last step that were taken, and the largest price of joining the intervals."""

    slack: Float[Array, "phases parts rooms"]
    price: Float[Array, "phases parts rooms"]
    interval_of_part: Int[Array, "phases parts"]
    level: Float[Array, ""]
    temperature: Float[Array, ""]
    coldest: Float[Array, ""]
    steps: Float[Array, "2"]
    joining: Float[Array, ""]


def interior_point(phases: int, further: int) -> optax.GradientTransformationExtraArgs:
    """The primal-dual direction as an optax transformation; wants `linear=`, and makes its own gradient from it.

    `extra_parts` is how many parts intervals may have beyond one each (`shooting.extra_parts`).
    """

    def init(params):
        knots = (params.shape[0] // phases - 1) // 4
        shape = (phases, knots - 1 + further, slack_sizes(knots))
        level, hot, cold = (jnp.full((), value) for value in (jnp.nan, MU_MAX, MU_MIN))
        owner = jnp.zeros(shape[:2], int)
        return InteriorPointState(
            jnp.ones(shape), jnp.zeros(shape), owner, level, hot, cold, jnp.zeros(2), jnp.zeros(())
        )

    def update(updates, state: InteriorPointState, params=None, *, linear: LinearisedProblem, damping, **_):
        at, bears, hot = linear.at, linear.bears, state.temperature
        live = linear.weight > 0
        least = jnp.where(live & (bears > 0), at.room, jnp.inf).min()
        level = jnp.where(jnp.isnan(state.level), least - 2 * LEAST, state.level)
        given = jnp.where(live, at.room - bears * level, 1.0)
        moved_on = (
            state.interval_of_part != linear.interval_of_part
        )  # what is known of a part is of no use to another interval's
        fresh = ~(state.price > 0) | moved_on[..., None]
        slack = jnp.where(live, jnp.maximum(given, jnp.where(fresh, LEAST, state.slack)), 1.0)
        target = hot * linear.weight / slack
        price = jnp.where(live, jnp.where(fresh, target, state.price), 0.0)
        stiff = price / slack
        miss = given - slack
        aim = jnp.where(live, target - stiff * miss, 0.0)
        way, rise, joining = kkt_step(linear, stiff, aim, damping)
        dslack = jacobian_product(linear, way) - bears * rise + miss
        dslack = jnp.where(live, dslack, 0.0)
        dprice = jnp.where(live, target - price - stiff * dslack, 0.0)
        primal = jnp.minimum(_fraction_to_boundary(slack, dslack), _step_cap(linear, way))
        dual = _fraction_to_boundary(price, dprice)
        both = jnp.minimum(primal, dual)
        cooling = jnp.select([both > 0.5, both > 0.2, both > STALL_STEP], [0.2, 0.6, 1.0], MU_INCREASE)
        floor = (both < STALL_STEP) & (hot < 2 * state.coldest)
        coldest = jnp.where(floor, jnp.minimum(MU_MIN_INCREASE * state.coldest, MU_MIN_MAX), state.coldest)
        state = InteriorPointState(
            slack + primal * dslack,
            price + dual * dprice,
            linear.interval_of_part,
            level + primal * rise,
            jnp.clip(hot * cooling, coldest, MU_MAX),
            coldest,
            jnp.stack([primal, dual]),
            jnp.abs(joining).max(),
        )
        return primal * way, state

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _fraction_to_boundary(value, change):
    """The share of a change that keeps every value positive."""
    falls = change < 0
    return jnp.minimum(1.0, NEAR * jnp.where(falls, -value / jnp.where(falls, change, 1.0), jnp.inf).min())


def _step_cap(linear: LinearisedProblem, way):
    """The share of a step that keeps the states' changes within `LONGEST`."""
    change = jnp.abs(way[of_states(linear)].reshape(-1, 2)).max(0)
    return (jnp.array(LONGEST) / jnp.maximum(change, 1e-30)).min()


class Cooling(NamedTuple):
    """State of `projected`: the inner optimiser's, the level `m` of the smooth margin, and as in `InteriorPointState`.
    Its steps
    keep the intervals joined, as far as they are linear: that has no price."""

    inner: optax.OptState
    level: Float[Array, ""]
    temperature: Float[Array, ""]
    coldest: Float[Array, ""]
    steps: Float[Array, "2"]
    joining: Float[Array, ""]


def projected(optimiser: optax.GradientTransformation, cooling: float = 0.98) -> optax.GradientTransformationExtraArgs:
    """Any optax optimiser on torques and duration: its updates are projected onto those with which the intervals join
    and phases arrive. The temperature falls by `cooling` a step."""
    optimiser = optax.with_extra_args_support(optimiser)

    def init(params):
        level, hot, cold = (jnp.full((), value) for value in (jnp.nan, MU_MAX, MU_MIN))
        return Cooling(optimiser.init(params), level, hot, cold, jnp.zeros(2), jnp.zeros(()))

    def update(updates, state: Cooling, params=None, *, linear: LinearisedProblem, **extra):
        at, hot = linear.at, state.temperature
        _, level = log_barrier_minimum(at.room, linear.weight * linear.bears, hot)
        above = at.room - linear.bears * level
        # Outside a limit the loss is infinite: there the pull back to it is that of a small room.
        pull = jacobian_transpose_product(linear, hot * linear.weight / jnp.maximum(above, hot))
        joined = linear._replace(defect=jnp.zeros_like(linear.defect))
        gradient = project_step(joined, -pull).at[of_states(linear)].set(0.0)
        updates, inner = optimiser.update(gradient, state.inner, params, **extra)
        way = project_step(linear, jnp.asarray(updates).at[of_states(linear)].set(0.0))
        change = jacobian_product(linear, way)
        within = (linear.weight > 0) & (linear.bears == 0) & (at.room > 0)
        reach = _fraction_to_boundary(jnp.where(within, at.room, 1.0), jnp.where(within, change, 0.0))
        share = jnp.minimum(reach, _step_cap(linear, way))
        cooled = jnp.maximum(cooling * hot, state.coldest)
        after = Cooling(inner, level, cooled, state.coldest, jnp.stack([share, share]), state.joining)
        return share * way, after

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def retract(p: Variables, way: Variables, share, phase_dynamics: PathDynamics, limits: Limits) -> Variables:
    """`p` after a `step_fraction` of a direction, on the curve along which accelerations and squeezes at knots change
    evenly.

    Torques balance to a small remainder, the acceleration: where the state at a knot moves, they have to move with it.
    The curve's tangent is the direction. A knot that passes from one piece of the wire to another goes straight.
    """

    def balance(dynamics, state, log):
        """Acceleration in lengths a duration squared is `rest + pull . torque`, the squeeze `free . torque`."""
        motion = acceleration_terms(dynamics, dynamics.breakpoints[0] + dynamics.length * state[0])
        time = jnp.exp(log)
        v = state[1] * dynamics.length / time
        rest = motion[0] + motion[1] * v**2 + motion[2] * v
        pull = motion[3:] * dynamics.torque_limit
        free = jnp.stack([-pull[1], pull[0]]) / jnp.sqrt(jnp.maximum(pull @ pull, 1e-300))
        return time**2 / dynamics.length * rest, time**2 / dynamics.length * pull, free

    def knot(dynamics, log, dlog, state, torque, dstate, dtorque, pinned):
        def motion(state, torque, log):
            rest, pull, free = balance(dynamics, state, log)
            return rest + pull @ torque, free @ torque

        (a, squeeze), (da, dsqueeze) = jax.jvp(motion, (state, torque, log), (dstate, dtorque, dlog))
        there, straight = state + share * dstate, torque + share * dtorque
        rest, pull, free = balance(dynamics, there, log + share * dlog)
        size = pull @ pull
        curved = pull * (a + share * da - rest) / jnp.where(size > 0, size, 1.0) + free * (squeeze + share * dsqueeze)
        segment = [
            (dynamics.breakpoints[0] + dynamics.length * s[0] >= dynamics.breakpoints[1:-1]).sum()
            for s in (state, there)
        ]
        return jnp.where((segment[0] == segment[1]) & (size > 0) & ~pinned, curved, straight)

    knots = jax.vmap(jax.vmap(knot, (None, None, None, 0, 0, 0, 0, 0)))
    return Variables(
        knots(
            phase_dynamics, p.log_duration, way.log_duration, p.state, p.torque, way.state, way.torque, limits.pinned
        ),
        p.state + share * way.state,
        p.log_duration + share * way.log_duration,
    )


class SolverState(NamedTuple):
    """A descent on its way: variables, the optimiser's state, and the step that led here, to take again if it failed.

    `plan_margin` is each phase's smallest sampled force over its unit and `apart` the sum of the defects, both of the
    variables before the step (NaN where those were not kept). `reach` is the part of a step that is taken. `merit` is
    that of the variables before the step at the temperature `hot`, and `rise` the most by which the step may raise it;
    where that is infinite the merit is not computed, and is infinite too. `damping` is the price of the step's size (of
    the interior point's).
    """

    p: Variables
    state: Any  # the optimiser's, with `temperature`, `coldest`, `steps` and `joining`
    before: Variables
    way: Variables
    step_fraction: Float[Array, ""]
    least: Float[Array, "phases"]
    apart: Float[Array, ""]
    reach: Float[Array, ""]
    rise: Float[Array, ""]
    damping: Float[Array, ""]
    merit: Float[Array, ""]
    hot: Float[Array, ""]


def merit(linear: LinearisedProblem, hot, joining) -> Float[Array, ""]:
    """What steps shall lower: the loss at a temperature, and a penalty of twice the price of `joining` on `|e|`.

    Where a room is none, as a start may have it, its logarithm goes on as a tangent.
    """
    at, bears = linear.at, linear.bears
    margin, _ = log_barrier_minimum(at.room, linear.weight * bears, hot)
    weight = linear.weight * (1 - bears)
    room = jnp.where(weight > 0, at.room, 1.0)
    log = jnp.where(room > EDGE, jnp.log(jnp.maximum(room, EDGE)), math.log(EDGE) + (room - EDGE) / EDGE)
    return -margin - hot * (weight * log).sum() + 2 * joining * defect_norm(linear)


def defect_norm(linear: LinearisedProblem):
    return jnp.abs(linear.defect).sum()


@Program
def init_solver(p: Variables, optimiser) -> SolverState:
    """A descent before its first step."""
    zero, still = jnp.zeros(()), jax.tree.map(jnp.zeros_like, p)
    state = optimiser.init(ravel_pytree(p)[0])
    worst = zero + jnp.inf  # no step is worse
    unknown = 0 * p.log_duration
    return SolverState(p, state, p, still, zero + 1, unknown, zero, zero + 1, worst, zero, worst, state.temperature)


@Program
def take_step(
    d: SolverState, phase_dynamics: PathDynamics, limits: Limits, options: IntegratorOptions, optimiser
) -> SolverState:
    """Simulate, and take a step; where `d.p` cannot be simulated or is worse, go back and take a shorter one."""
    linear = linearise(d.p, phase_dynamics, limits, options)
    at = linear.at
    sound = jnp.all(jnp.isfinite(at.room)) & jnp.all(jnp.isfinite(linear.defect))
    held = jnp.isfinite(d.rise)
    better = jax.lax.cond(held, lambda: merit(linear, d.hot, d.state.joining) <= d.merit + d.rise, lambda: held | True)
    least = jnp.where((linear.weight > 0) & (linear.bears > 0), at.room, jnp.inf).min((1, 2))
    apart = defect_norm(linear)

    def onward():
        flat, unravel = ravel_pytree(d.p)
        way, state = optimiser.update(jnp.zeros_like(flat), d.state, flat, linear=linear, damping=d.damping)
        hot = d.state.temperature
        here = jax.lax.cond(held, lambda: merit(linear, hot, state.joining), lambda: jnp.full_like(d.merit, jnp.inf))
        return SolverState(
            d.p, state, d.p, unravel(way), jnp.ones(()), least, apart, d.reach, d.rise, d.damping, here, hot
        )

    def again():
        least, apart = (jnp.full_like(a, jnp.nan) for a in (d.least, d.apart))
        return d._replace(step_fraction=d.step_fraction * SHORTER, least=least, apart=apart)

    after = jax.lax.cond(sound & (better | (d.step_fraction < SMALL)), onward, again)
    return after._replace(p=retract(after.before, after.way, after.step_fraction * after.reach, phase_dynamics, limits))
