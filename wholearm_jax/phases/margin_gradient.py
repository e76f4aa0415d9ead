"""Gradient of a plan's margin where its inputs are numbers, from two programs that compile side by side.

A margin is one number: its slopes along all directions of its inputs are its gradient, whichever mode asks for it. One
program traces the plan, the other simulates it, each with a fixed number of directions at a time. They serve every plan
with as many phases, and are kept as other programs are (`core.program_cache`). Reverse mode through both takes several
times as long to compile.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from wholearm_jax.core import CachedJit, as_device_array, compile_in_background, wait_for
from wholearm_jax.dynamics import PathDynamics, placeholder_dynamics
from wholearm_jax.model import Arrival, Scene, TorqueSchedule, pad_schedule
from wholearm_jax.phases.assessment import DEFAULT_ARRIVAL
from wholearm_jax.phases.plan_simulation import simulate_in_one_program
from wholearm_jax.phases.plan_tracing import refine_in_one_program, trace_in_one_program
from wholearm_jax.simulation import Adjoint, IntegratorOptions, tolerance_as_data
from wholearm_jax.tracing import Resolution

DIRECTION_BATCH = 64  # that a program takes at a time
COMPILED_SOONER = {"xla_backend_optimization_level": 0}  # half the time to compile, and twice to run


class TracedAlong(NamedTuple):
    """Path dynamics of a plan's phases, stacked, and the slopes of their floats along directions."""

    dynamics: PathDynamics
    slopes: PyTree[Array | np.ndarray]  # leading axis: directions


class Timed(NamedTuple):
    """What moves a plan along its paths, or its slopes along directions."""

    durations: Float[Array | np.ndarray, "*directions phases"]  # [s]
    schedule: TorqueSchedule


def margin_and_gradient(inputs, tangents, options: IntegratorOptions, resolution: Resolution):
    """Compute the margin of a plan and its gradient.

    Args:
        inputs: Scene with its plan, and a torque schedule that covers it; both numbers.
        tangents: A tree like `inputs` with None for what is not differentiated.
        options: Integrator options, of which `adjoint` does not matter.
        resolution: Sizes of the tables to begin with.

    Returns:
        The margin [N], and its gradient: a tree like `tangents`.
    """
    chosen = jax.tree.map(lambda _, tangent: tangent is not None, inputs, tangents)
    scene, torque = _without_names(inputs[0]), inputs[1]
    options = tolerance_as_data(replace(options, adjoint=Adjoint.FORWARD), torque.times.dtype)
    arrivals = np.asarray([int(phase.arrive) for phase in scene.phases])
    timed = Timed(_durations(scene), pad_schedule(torque))
    # The simulation compiles on a second thread while paths are traced on this one.
    placeholders = _placeholders(resolution, len(scene.phases)), timed
    (dynamics, dynamics_slopes), (_, timed_slopes) = jax.device_put([(one, _zero_slopes(one)) for one in placeholders])
    traced = TracedAlong(dynamics, dynamics_slopes)
    compiled = compile_in_background(_margin_along, traced, timed, timed_slopes, arrivals, options)

    traced, value, slopes = None, None, []
    for along_scene, along_torque in _unit_directions((scene, torque), jax.tree.leaves(chosen)):
        if traced is None or any(leaf.any() for leaf in jax.tree.leaves(along_scene)):
            traced = refine_in_one_program(partial(_trace_along, scene, along_scene), resolution)
        else:
            traced = traced._replace(slopes=_zero_slopes(traced.dynamics))
        wait_for(compiled)
        along = Timed(as_device_array(_durations(along_scene)), pad_schedule(along_torque))
        value, part = _margin_along(traced, timed, along, arrivals, options)
        slopes.append(np.asarray(part))
    return value, _as_tree(np.concatenate(slopes), inputs, chosen)


@partial(CachedJit, compiler_options=COMPILED_SOONER)
def _trace_along(scene: Scene, directions, resolution: Resolution) -> TracedAlong:
    """Trace a plan, with the slopes of its path dynamics along directions of the scene's floats."""
    floats, rest = eqx.partition(scene, eqx.is_inexact_array)

    def dynamics(floats):
        return eqx.partition(trace_in_one_program(eqx.combine(floats, rest), resolution).dynamics, eqx.is_inexact_array)

    def along(direction):
        return jax.jvp(dynamics, (floats,), (direction,), has_aux=True)

    values, slopes, others = jax.vmap(along, out_axes=(None, 0, None))(directions)
    return TracedAlong(eqx.combine(values, others), slopes)


@partial(CachedJit, compiler_options=COMPILED_SOONER)
def _margin_along(
    traced: TracedAlong, timed: Timed, directions: Timed, arrivals: Int[Array, "phases"], options: IntegratorOptions
) -> tuple[Float[Array, ""], Float[Array, "directions"]]:
    """Simulate a plan, and compute its margin [N] with the margin's slopes along directions."""
    floats, rest = eqx.partition(traced.dynamics, eqx.is_inexact_array)

    def margin(floats, timed: Timed):
        phases = eqx.combine(floats, rest), timed.durations, arrivals, arrivals == int(Arrival.MOVING)
        arrival = jnp.asarray(DEFAULT_ARRIVAL, timed.durations.dtype)
        margins = simulate_in_one_program(phases, timed.schedule, options, arrival).margin_result.margin
        margins = jnp.where(jnp.isfinite(margins), margins, -jnp.inf)
        return jnp.where(arrivals == int(Arrival.HOLD), jnp.inf, margins).min()

    def along(*direction):
        return jax.jvp(margin, (floats, timed), direction)

    return jax.vmap(along, out_axes=(None, 0))(traced.slopes, directions)


def _without_names(scene: Scene) -> Scene:
    """Return the scene without title and names, which would give each scene a program of its own."""
    dtype = scene.gravity.dtype
    phases = tuple(replace(phase, name="", duration=np.asarray(phase.duration, dtype)) for phase in scene.phases)
    return replace(scene, title="", phases=phases)


def _durations(scene) -> np.ndarray:
    """Return the phases' durations, or those of directions along a leading axis."""
    return np.stack([np.asarray(phase.duration) for phase in scene.phases], axis=-1)


def _placeholders(resolution: Resolution, phases: int) -> PathDynamics:
    """Return stacked path dynamics of the right shapes without content."""
    return jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * phases), placeholder_dynamics(resolution))


def _zero_slopes(tree):
    """Return slopes of zero for every float of a tree."""
    return jax.tree.map(
        lambda a: np.zeros((DIRECTION_BATCH, *a.shape), a.dtype), eqx.filter(tree, eqx.is_inexact_array)
    )


def _unit_directions(inputs, chosen: list[bool]) -> Iterator[Any]:
    """Yield unit directions of all numbers of the chosen leaves, so many at a time: trees of all floats.

    The last directions are filled up with zeros.
    """
    leaves, structure = jax.tree.flatten(inputs)
    sizes = [leaf.size if flag else 0 for leaf, flag in zip(leaves, chosen, strict=True)]
    begins = np.cumsum([0, *sizes[:-1]])
    for first in range(0, sum(sizes), DIRECTION_BATCH):
        row = np.arange(DIRECTION_BATCH)[:, None]
        blocks = []
        for leaf, begin, size in zip(leaves, begins, sizes, strict=True):
            place = (first + row == begin + np.arange(size)).astype(leaf.dtype) if size else 0.0
            block = (np.zeros((DIRECTION_BATCH, leaf.size), leaf.dtype) + place).reshape(DIRECTION_BATCH, *leaf.shape)
            blocks.append(block if eqx.is_inexact_array(leaf) else None)
        yield jax.tree.unflatten(structure, blocks)


def _as_tree(slopes: np.ndarray, inputs, chosen):
    """Return slopes along the unit directions as a tree like `inputs`, with None for what is not chosen."""
    leaves, structure = jax.tree.flatten(inputs)
    parts, begin = [], 0
    for leaf, flag in zip(leaves, jax.tree.leaves(chosen), strict=True):
        parts.append(slopes[begin : begin + leaf.size].reshape(leaf.shape) if flag else None)
        begin += leaf.size if flag else 0
    return jax.tree.unflatten(structure, parts)
