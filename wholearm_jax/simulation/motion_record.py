"""The motion of a phase, and its record while it is simulated."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import take_row
from wholearm_jax.simulation.closed_loop import PhaseLoop, torque_of
from wholearm_jax.simulation.integrator import AcceptedSteps


class Motion(NamedTuple):
    """The steps of a phase: step `i` leads from node `i` to node `i + 1`. Nodes beyond `count` repeat the last."""

    # nodes
    phase_time: Float[Array, "nodes"]  # time over the duration
    s: Float[Array, "nodes"]
    w: Float[Array, "nodes"]  # ds per duration

    # steps
    w_begin: Float[Array, "steps"]  # w at the begin of a step, in the chart of its segment
    segment: Int[Array, "steps"]  # of the path
    row: Int[Array, "steps"]  # interval of the torque schedule
    at_rest: Bool[Array, "steps"]  # whether friction holds the object

    # end
    count: Int[Array, ""]  # number of steps
    status: Int[Array, ""]
    """`ok` (time is over while the object moves), `left_formation` (at the path's end), `stuck`, `reversed`,
    `ambiguous`, `no_convergence` (of the step to an event) or `max_steps`."""

    memory: Float[Array, "nodes memory"] | None = None  # of a closed-loop law at the nodes


def torques_of_step(loop: PhaseLoop, motion: Motion, k) -> Float[Array, "corners 2"]:
    """Return the torques of a closed loop where step `k` of a motion begins and ends."""
    assert motion.memory is not None
    nodes = jnp.stack([k, k + 1])
    row = take_row(motion.row, k)
    return jax.vmap(torque_of, (None, None, 0, 0))(loop, row, motion.phase_time[nodes], motion.memory[nodes])


class MotionRecord(NamedTuple):
    """The steps so far, as in `Motion`."""

    nodes: Float[Array, "nodes columns"]  # phase time, s, w and, in closed loop, the memory
    w_begin: Float[Array, "steps"]
    segment: Int[Array, "steps"]
    row: Int[Array, "steps"]
    at_rest: Bool[Array, "steps"]
    count: Int[Array, ""]

    @property
    def capacity(self) -> int:
        """The number of steps that there is room for."""
        return self.w_begin.shape[0]


def empty_record(capacity: int, first: Float[Array, "columns"], row: Int[Array, ""]) -> MotionRecord:
    """Make a record without steps that begins at the node `first`, in the interval `row`."""
    return MotionRecord(
        nodes=jnp.broadcast_to(first, (capacity + 1, *first.shape)),
        w_begin=jnp.zeros(capacity, first.dtype),
        segment=jnp.zeros(capacity, int),
        row=jnp.broadcast_to(row.astype(int), capacity),
        at_rest=jnp.zeros(capacity, bool),
        count=jnp.asarray(0, int),
    )


def append_step(record: MotionRecord, is_needed, node, w_begin, segment, row, *, at_rest: bool) -> MotionRecord:
    """Append one step that ends at `node`, if it is needed and there is room."""
    capacity = record.capacity
    place = jnp.where(is_needed & (record.count < capacity), record.count + 1, capacity + 1)
    return MotionRecord(
        nodes=record.nodes.at[place].set(_join(node), mode="drop"),
        w_begin=record.w_begin.at[place - 1].set(w_begin, mode="drop"),
        segment=record.segment.at[place - 1].set(segment, mode="drop"),
        row=record.row.at[place - 1].set(row, mode="drop"),
        at_rest=record.at_rest.at[place - 1].set(at_rest, mode="drop"),
        count=record.count + (place <= capacity),
    )


def _join(node) -> Float[Array, "columns"]:
    """Join phase time, s, w and the memory of a law, None in open loop."""
    *numbers, memory = node
    return jnp.stack(numbers) if memory is None else jnp.concatenate([jnp.stack(numbers), memory])


def append_rest(record: MotionRecord, steps: AcceptedSteps, s, segment, count) -> MotionRecord:
    """Append the first `count` steps of a rest at `s`; their states are (phase time, 0, *memory)."""
    rows = jnp.arange(record.capacity)
    place = jnp.where(rows < count, record.count + 1 + rows, record.capacity + 1)
    at_rest = record.at_rest.at[place - 1].set(True, mode="drop")
    still = steps._replace(y=steps.y.at[:, 0].set(s))
    first = jnp.concatenate([s[None], still.y[0, 1:]])
    return append_steps(record._replace(at_rest=at_rest), still, first, segment, count)


def append_steps(record: MotionRecord, steps: AcceptedSteps, y: Float[Array, "state"], segment, count) -> MotionRecord:
    """Append the first `count` of the steps that begin at the state `y`."""
    capacity = record.capacity
    rows = jnp.arange(capacity)
    place = jnp.where(rows < count, record.count + 1 + rows, capacity + 1)
    nodes = jnp.concatenate([steps.end[:, None], steps.y], axis=1)
    w_begin = jnp.concatenate([y[1:2], steps.y[:-1, 1]])
    return record._replace(
        nodes=record.nodes.at[place].set(nodes, mode="drop"),
        w_begin=record.w_begin.at[place - 1].set(w_begin, mode="drop"),
        segment=record.segment.at[place - 1].set(segment, mode="drop"),
        row=record.row.at[place - 1].set(steps.row, mode="drop"),
        count=record.count + count,
    )


def recorded_motion(record: MotionRecord, status: Int[Array, ""]) -> Motion:
    """Make the motion of a record."""
    is_beyond = jnp.arange(record.capacity + 1) > record.count
    nodes = jnp.where(is_beyond[:, None], record.nodes[record.count], record.nodes)
    memory = nodes[:, 3:] if nodes.shape[1] > 3 else None
    steps = record.w_begin, record.segment, record.row, record.at_rest
    return Motion(nodes[:, 0], nodes[:, 1], nodes[:, 2], *steps, record.count, status.astype(int), memory)
