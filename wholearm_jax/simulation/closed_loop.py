r"""A closed-loop law in the time of one phase: its torque, and the rate of what it remembers.

In continuous time the law of `docs/feedback.md` is an ordinary differential equation for its memory `(s, v, i)`, the
observed place and speed and the integral part, driven by the place `q` of the true joint angles:

    ds/dt = v + 2 w_o (q - s),    dv/dt = dv_ref/dt + w_o^2 (q - s)
    di/dt = k (a - 2 w (v_ref - v) - i)    with the acceleration `a` asked for, after it was cut

Along a path `q` is a function of the path's own parameter; the torque is one of time and memory.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import take_row
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.model import PhaseSchedule, torque_at

SEARCH_BLOCK = 16  # rows of a block, in tables whose length is a multiple of it


class PhaseLoop(eqx.Module):
    """The law of one phase on one path, in phase time; stands where a `PhaseSchedule` does in open loop.

    Interval `k` of the reference runs from row `k` to row `k + 1`; the reference may jump between intervals.
    """

    # over phase time
    phase_time: Float[Array, "rows"]
    reference: Float[Array, "rows_less_1 4"]  # s_ref [rad], v_ref [rad/s], torque [N m], where each interval begins
    slope: Float[Array, "rows_less_1 4"]  # their rates in phase time
    presses: Bool[Array, "rows_less_1"]  # whether `press` bounds the feedback forward
    first: Int[Array, ""]  # interval
    last: Int[Array, ""]  # interval

    # along the path
    place: Float[Array, "panels powers"]  # of the joint angles on the law's curve [rad], as functions of `PathDynamics`
    s: Float[Array, "nodes"]
    gain: Float[Array, "nodes 2"]

    # constants
    stiffness: Float[Array, ""]
    integral: Float[Array, ""]
    observer: Float[Array, ""]
    push: Float[Array, ""]
    press: Float[Array, ""]
    torque_limit: Float[Array, "2"]


Actuation = PhaseSchedule | PhaseLoop
"""What gives the torques of a phase."""


def interpolate_rows(places: Float[Array, "rows"], values: Float[Array, "rows *shape"], at) -> Float[Array, "*shape"]:
    """Interpolate a table linearly; it is constant beyond its ends."""
    k = jnp.clip(_row_before(places, stop_gradient(at)), 0, places.shape[0] - 2)
    begin, end = take_row(places, k), take_row(places, k + 1)
    share = jnp.clip((at - begin) / jnp.where(end > begin, end - begin, 1.0), 0.0, 1.0)
    low, high = take_row(values, k), take_row(values, k + 1)
    return low + share * (high - low)


def _row_before(places: Float[Array, "rows"], at) -> Int[Array, ""]:
    """Return the last row at or before a place (-1: none): of a long table its block first, then the row in it."""
    if places.shape[0] % SEARCH_BLOCK:
        return (at >= places).sum() - 1
    block = jnp.maximum((at >= places[::SEARCH_BLOCK]).sum() - 1, 0) * SEARCH_BLOCK
    return block + (at >= jax.lax.dynamic_slice_in_dim(places, block, SEARCH_BLOCK)).sum() - 1


def _act(loop: PhaseLoop, row, phase_time, memory):
    """Return the feed-forward torque, the gain, the acceleration asked for, and the integral part's rate."""
    since = phase_time - take_row(loop.phase_time, row)
    now = take_row(loop.reference, row) + take_row(loop.slope, row) * since
    s, v, i = memory
    gain = interpolate_rows(loop.s, loop.gain, s)
    most = loop.push / jnp.abs(gain).max()
    ahead = jnp.where(take_row(loop.presses, row), jnp.minimum(most, loop.press), most)
    damping = 2 * loop.stiffness * (now[1] - v)
    uncut = loop.stiffness**2 * (now[0] - s) + damping + i
    acceleration = jnp.minimum(jnp.maximum(uncut, -most), ahead)
    return now[2:], gain, acceleration, loop.integral * (acceleration - damping - i)


def torque_of(actuation: Actuation, row, phase_time, memory=None) -> Float[Array, "2"]:
    """Evaluate the torque [N m] of a schedule, or of a law with its memory, in an interval."""
    if not isinstance(actuation, PhaseLoop):
        return torque_at(actuation, row, phase_time)
    torque, gain, acceleration, _ = _act(actuation, row, phase_time, memory)
    return jnp.clip(torque + gain * acceleration, -actuation.torque_limit, actuation.torque_limit)


def memory_rate(actuation: PhaseLoop, dynamics: PathDynamics, duration, segment, row, phase_time, s, memory):
    """Evaluate the rate of the memory in phase time, where the path's parameter is `s`."""
    off = place_on_path(actuation, dynamics, segment, s) - memory[0]
    *_, integral = _act(actuation, row, phase_time, memory)
    rate = jnp.stack([memory[1] + 2 * actuation.observer * off, actuation.observer**2 * off, integral])
    return (duration * rate).at[1].add(take_row(actuation.slope, row)[1])


def place_on_path(loop: PhaseLoop, dynamics: PathDynamics, segment, s) -> Float[Array, ""]:
    """Return the place [rad] of the joint angles at the path's parameter `s` on the law's curve."""
    return evaluate(loop.place, *locate_panel(dynamics, segment, s))
