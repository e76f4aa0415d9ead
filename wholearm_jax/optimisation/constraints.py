"""Constraints of the optimisation: inequalities `g(p) >= 0` in each part of each interval, and equalities `e(p) = 0`.

Inequalities keep forces above the margin's level, torques, torque rates and durations within their limits and speeds
positive. Equalities make the intervals join (defects) and link the phases.

Derivation: section 9 of `docs/derivation.md`.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel, resolve_impact
from wholearm_jax.margin import is_duplicate_facet
from wholearm_jax.optimisation.interval_samples import (
    SLACKS_PER_SAMPLE,
    SPEED_COEFFICIENTS,
    PartSamples,
    samples_per_part,
)
from wholearm_jax.optimisation.multiple_shooting import simulate_intervals
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.simulation import IntegratorOptions


class Limits(eqx.Module):
    """Limits that the result must respect.

    A phase that starts at rest with a fixed torque may start with zero acceleration.
    """

    rate: Float[Array, "2"]  # largest torque rates [N m/s]; infinite: unlimited
    shortest: Float[Array, "phases"]  # durations [s]
    longest: Float[Array, "phases"]
    min_transition_speed: Float[Array, ""]  # of phases that start moving [path lengths a duration]
    fixed_torques: Bool[Array, "phases knots"]  # knots whose torques stay as they are
    force_scale: Float[Array, "phases"]  # unit of forces [N]
    hand_over: Float[Array, "phases intervals rows 5"]  # `hand_over_rows`


def _has_phase_axis(limits: Limits) -> Limits:
    """Mark the limits that have an entry for each phase."""
    marked = jax.tree.map(lambda _: True, limits)
    return eqx.tree_at(lambda of: (of.rate, of.min_transition_speed), marked, (False, False))


class ConstraintValues(NamedTuple):
    """What intervals are constrained by."""

    inequality: Float[Array, "phases parts inequalities"]  # g; forces come first
    end: Float[Array, "phases intervals 2"]  # states in which the intervals end, as in `Variables`


def force_count(knots: int) -> int:
    """Return the number of force inequalities of a part: the first ones, which the margin's level lowers."""
    return samples_per_part(knots - 1) * SLACKS_PER_SAMPLE


def inequality_count(knots: int, hand_over_rows: int = 0) -> int:
    """Return the number of inequalities of a part: forces, torques, torque rates, speeds, durations, hand-overs."""
    return force_count(knots) + 8 + 4 + SPEED_COEFFICIENTS + 2 + hand_over_rows


def evaluate_constraints(
    q: Float[Array, "phases intervals 7"], phase_dynamics: PathDynamics, limits: Limits, options: IntegratorOptions
) -> tuple[ConstraintValues, tuple[Float[Array, "phases parts inequalities"], Int[Array, "phases parts"]]]:
    """Simulate all intervals of all phases, one phase after the other.

    Args:
        q: inputs of the intervals (`interval_inputs`).
        phase_dynamics: path dynamics of the phases, stacked.
        limits: limits of the phases.
        options: solver of the steps.

    Returns:
        The constraints' values; and, without derivatives, the inequalities' weights (0: does not exist) and the
        interval of each part.
    """
    phases, intervals = q.shape[:2]
    # Only the first interval of a phase has a least speed; -inf: it starts at rest.
    min_speed = jnp.zeros((phases, intervals)).at[:, 0].set(limits.min_transition_speed).at[0, 0].set(-jnp.inf)
    of_phase, shared = eqx.partition(limits, _has_phase_axis(limits))

    def one_phase(phase):
        q, min_speed, dynamics, of_phase = phase
        results = simulate_intervals(dynamics, options, intervals, q)
        owner = results.interval_of_part
        is_first = jnp.arange(owner.size) < intervals
        part_min_speed = jnp.where(is_first, min_speed[owner], 0.0)
        each_part = jax.vmap(partial(_part_inequalities, intervals), (0, 0, 0, 0, 0, None, None))
        limits = eqx.combine(of_phase, shared)
        rows = limits.hand_over[owner]
        inequality, weight = each_part(q[owner], results.parts, is_first, part_min_speed, rows, dynamics, limits)
        return ConstraintValues(inequality, results.end), (stop_gradient(weight), owner)

    return jax.lax.map(one_phase, (q, min_speed, phase_dynamics, of_phase))


def _part_inequalities(
    intervals: int,
    q: Float[Array, "7"],
    part: PartSamples,
    is_first,
    min_speed,
    hand_over: Float[Array, "rows 5"],
    dynamics: PathDynamics,
    limits: Limits,
) -> tuple[Float[Array, "inequalities"], Float[Array, "inequalities"]]:
    """Return the inequalities of one part of an interval, and their weights.

    Those that do not depend on the part belong to the interval's first one. `min_speed` is the least speed with which
    the part may begin, -inf where it starts at rest, and `hand_over` the interval's `hand_over_rows`.
    """
    torque, log_duration = q[2:6], q[6]

    # Torque rates, over the limits.
    rate_limited = jnp.isfinite(limits.rate)
    max_change = jnp.where(rate_limited, limits.rate, 1.0) / dynamics.torque_limit * jnp.exp(log_duration) / intervals
    rate = jnp.where(rate_limited, (torque[2:] - torque[:2]) / max_change, 0.0)

    # Durations, by their logarithms over the range's.
    log_range = jnp.log(limits.longest / limits.shortest)
    is_free = log_range > 0
    to_limits = jnp.stack([log_duration - jnp.log(limits.shortest), jnp.log(limits.longest) - log_duration])
    duration = to_limits / jnp.where(is_free, log_range, 1.0)

    # Speeds: from rest the first coefficient is the speed, zero, and the second the acceleration.
    starts_moving = min_speed > -jnp.inf
    speed = part.speed.at[0].add(-jnp.where(starts_moving, min_speed, 0.0))
    may_rest = starts_moving | ~limits.fixed_torques[0]
    speed_weight = part.speed_weight.at[0].multiply(starts_moving).at[1].multiply(may_rest)

    force = (part.force / limits.force_scale).ravel()
    force_weight = (part.force_weight[:, None] * ~is_duplicate_facet(dynamics)).ravel()
    once = is_first / intervals
    rate_weight = jnp.tile(jnp.where(rate_limited, once / 4, 0.0), 2)
    duration_weight = jnp.full(2, jnp.where(is_free, once / 4, 0.0))
    either = hand_over @ jnp.append(1.0, torque)
    either_weight = jnp.where(jnp.any(hand_over != 0, 1), once / 4, 0.0)
    values = [force, 1 - torque, 1 + torque, 1 - rate, 1 + rate, speed, duration, either]
    weights = [force_weight, jnp.full(8, once / 4), rate_weight, speed_weight, duration_weight, either_weight]
    return jnp.concatenate(values), jnp.concatenate(weights)


def linkage_defects(p: Variables, phase_dynamics: PathDynamics) -> Float[Array, "linkages"]:
    """Return what must vanish where a phase follows at speed: errors of its first speed after the impact, torque jumps.

    A torque jump at the moment of the change would act in the wrong contact formation whenever the object is early or
    late, be it by rounding: the margin would jump with the torques.
    """
    if p.torque.shape[0] == 1:
        return jnp.zeros(0)
    before, after = (jax.tree.map(lambda a, k=k: a[k], phase_dynamics) for k in (slice(0, -1), slice(1, None)))
    speed = before.length / jnp.exp(p.log_duration[:-1]) * p.state[:-1, -1, 1]
    speed_after = impact_speed_ratio(before, after) * speed
    speed_error = p.state[1:, 0, 1] - speed_after * jnp.exp(p.log_duration[1:]) / after.length
    return jnp.concatenate([speed_error, (p.torque[1:, 0] - p.torque[:-1, -1]).ravel()])


def impact_speed_ratio(before: PathDynamics, after: PathDynamics) -> Float[Array, "linkages"]:
    """Return `ds/dt` after each change of contact formation over that before it; path dynamics are stacked."""

    def ratio(before, after):
        panel, xi = locate_panel(before, before.count - 1, before.breakpoints[-1])
        return resolve_impact(after, evaluate(before.velocity, panel, xi)).speed

    return jax.vmap(ratio)(before, after)


def fixed_variables(limits: Limits, phases: int, knots: int) -> Bool[Array, "p"]:
    """Mark the variables that stay: fixed torques and durations, path ends, rest at start and end."""
    state = np.zeros((phases, knots, 2), bool)
    state[:, [0, -1], 0] = state[0, 0] = state[-1, -1] = True
    duration = limits.longest <= limits.shortest
    return jnp.concatenate([jnp.repeat(limits.fixed_torques.ravel(), 2), jnp.asarray(state.ravel()), duration])
