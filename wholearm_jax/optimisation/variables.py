"""The variables of the optimisation, and where they stand in the flattened vector `p`.

`ravel_pytree` flattens `Variables` field by field: torques, states, durations; within a field phase by phase and knot
by knot. Each interval depends on seven of these numbers (`interval_inputs`), whatever the number of knots.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

INPUTS = 7  # variables that an interval depends on: s, v, two torques at its start, two at its end, log of the duration


class Variables(eqx.Module):
    """Variables of one phase, or of several phases that follow one another at speed."""

    torque: Float[Array, "phases knots 2"]  # at the knots, over the torque limits
    state: Float[Array, "phases knots 2"]  # (s, v) at the knots [path lengths from the start, path lengths a duration]
    log_duration: Float[Array, "phases"]  # logarithms of the durations [s]


def interval_inputs(p: Variables) -> Float[Array, "phases intervals 7"]:
    """Collect the variables of each interval: `s`, `v`, two torques at either end, log of the duration."""
    log_duration = jnp.broadcast_to(p.log_duration[:, None, None], (*p.torque[:, 1:].shape[:2], 1))
    return jnp.concatenate([p.state[:, :-1], p.torque[:, :-1], p.torque[:, 1:], log_duration], axis=2)


def interval_input_indices(phases: int, knots: int) -> Int[np.ndarray, "phases intervals 7"]:
    """Return the indices in `p` of `interval_inputs`."""
    size = 2 * phases * knots
    torque, state = np.arange(size).reshape(phases, knots, 2), _state_indices(phases, knots)
    duration = np.broadcast_to(2 * size + np.arange(phases)[:, None, None], (phases, knots - 1, 1))
    return np.concatenate([state[:, :-1], torque[:, :-1], torque[:, 1:], duration], axis=2)


def interval_end_indices(phases: int, knots: int) -> Int[np.ndarray, "phases intervals 2"]:
    """Return the indices in `p` of the state at the knot where each interval ends."""
    return _state_indices(phases, knots)[:, 1:]


def state_slice(phases: int, knots: int) -> slice:
    """Return the part of `p` that holds the states."""
    return slice(2 * phases * knots, 4 * phases * knots)


def variable_count(phases: int, knots: int) -> int:
    """Return the length of `p`."""
    return 4 * phases * knots + phases


def knot_count(size: int, phases: int) -> int:
    """Return the number of knots of a phase from the length of `p`: the inverse of `variable_count`."""
    return (size // phases - 1) // 4


def _state_indices(phases: int, knots: int) -> Int[np.ndarray, "phases knots 2"]:
    indices = np.arange(variable_count(phases, knots))
    return indices[state_slice(phases, knots)].reshape(phases, knots, 2)
