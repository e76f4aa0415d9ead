"""Samples of an interval: contact forces at even times, and numbers that bound the path velocity from below."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from wholearm_jax.dynamics import differentiate_polynomial
from wholearm_jax.margin import MAX_ROLLING, cone_facets, sampled_slacks
from wholearm_jax.optimisation.interval_steps import States, Times
from wholearm_jax.simulation import DenseOutput, PathODE, quintic_hermite

SINGLE_STEP_INTERVALS = 50  # intervals of a phase from which one solver step in each serves; fewer take two
SLACKS_PER_SAMPLE = 4 + MAX_ROLLING
SAMPLE_SPACINGS = 8  # between the times of an interval at which forces are sampled
COEFFICIENTS_PER_HALF = 4  # numbers that bound the speed from below in half of an interval
SPEED_COEFFICIENTS = 2 * COEFFICIENTS_PER_HALF


class PartSamples(NamedTuple):
    """Samples of one part of an interval. Weights are fractions of the phase; 0: the sample does not exist."""

    force: Float[Array, "*parts samples rows"]  # force slacks [N], `cone_facets`
    force_weight: Float[Array, "*parts samples"]
    speed: Float[Array, "*parts coefficients"]  # lower bounds, `_speed_lower_bounds` [path lengths a duration]
    speed_weight: Float[Array, "*parts coefficients"]


def steps_per_interval(intervals: int) -> int:
    """Return the number of solver steps in each part of an interval."""
    return 1 if intervals >= SINGLE_STEP_INTERVALS else 2


def samples_per_part(intervals: int) -> int:
    """Return the number of force samples in each part: evenly spaced, with both ends of each solver step."""
    return SAMPLE_SPACINGS + steps_per_interval(intervals)


def sample_part(ode: PathODE, intervals: int, times: Times, states: States, segment) -> PartSamples:
    """Sample the forces and bound the speeds of a part of an interval, given the ends of its steps."""
    count, samples = steps_per_interval(intervals), samples_per_part(intervals)
    steps = _dense_output(ode, times, states, segment)
    force = sampled_slacks(*ode, steps, samples // count, cone_facets).reshape(samples, -1)
    fraction = stop_gradient(times[-1] - times[0]) / intervals
    force_weight, speed_weight = (jnp.full(each, fraction / each) for each in (samples, SPEED_COEFFICIENTS))
    force = jnp.where(fraction > 0, force, 0.0)
    speed = _speed_lower_bounds(steps) / (ode.dynamics.length / intervals)
    return PartSamples(force, force_weight, speed, speed_weight)


def _dense_output(ode: PathODE, times: Times, states: States, segment) -> DenseOutput:
    """Interpolate the steps of a part."""
    phase_time, s, w = (jnp.stack([a[:-1], a[1:]], axis=1) for a in (times, states[:, 0], states[:, 1]))
    count = phase_time.shape[0]
    segments, row = jnp.broadcast_to(segment, count), jnp.zeros(count, int)
    live = phase_time[:, 1] > phase_time[:, 0]
    each_step = jax.vmap(quintic_hermite, (None, None, None, 0, 0, 0, 0, 0, 0))
    quintic = each_step(*ode, phase_time, s, w, segments, row, live)
    return DenseOutput(phase_time, quintic, segments, row, jnp.zeros(count, bool), live)


def _speed_lower_bounds(steps: DenseOutput) -> Float[Array, "coefficients"]:
    """Bound the speed `ds/du` from below in each half of an interval: it is never less than the least of these numbers.

    They are Bernstein coefficients of the quartic `ds/dxi`, all but the last: the first is the speed where the half
    begins, the last one the first of the next half. Speeds at sampled times alone would allow it to fall below zero
    between them, where a simulation of the whole phase would stop.
    """
    width = steps.phase_time[:, 1] - steps.phase_time[:, 0]
    parts_per_step = SPEED_COEFFICIENTS // COEFFICIENTS_PER_HALF // width.size
    coefficients = jax.vmap(differentiate_polynomial)(steps.quintic) @ _bernstein_matrix(parts_per_step).T
    live = steps.live[:, None]
    return jnp.where(live, coefficients / jnp.where(steps.live, width, 1.0)[:, None], 1.0).ravel()


@functools.cache
def _bernstein_matrix(parts: int) -> Float[np.ndarray, "coefficients 5"]:
    """Return the map from the monomial coefficients of a quartic on [0, 1] to its Bernstein coefficients but the last.

    The interval is divided into equal `parts`, each with coefficients of its own.
    """
    rows = range(COEFFICIENTS_PER_HALF)
    basis = np.array([[math.comb(i, j) / math.comb(4, j) for j in range(5)] for i in rows])
    restrict = [
        [[math.comb(j, i) * (k / parts) ** (j - i) / parts**i if i <= j else 0.0 for j in range(5)] for i in range(5)]
        for k in range(parts)
    ]
    return np.concatenate([basis @ np.array(matrix) for matrix in restrict])
