"""Tracing of a plan: every phase from where the one before it ended, refined until its tables are accurate."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import Status, as_device_array, computed_at_once, is_traced, stack_trees, unstack_trees
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.model import Arrival, Phase, Scene, alike_formations, rigid_body, scaled_mechanics
from wholearm_jax.phases.phase_ends import target_configuration
from wholearm_jax.phases.phase_tracing import TracedPhase, trace_phase, trace_phase_path
from wholearm_jax.tracing import ContactPath, Resolution

TABLE_ROUNDING = 1e4  # in units of machine epsilon, interpolation error that more panels do not reduce
MAX_PANELS = 512
TABLE_TOL = 1e-9  # interpolation error of the tables, relative to each function's size
MAX_SEGMENTS = 48
COARSE_TABLES = (
    "a table of this plan needs more panels or segments, which a program that is already compiled cannot add: "
    "pass resolution=wholearm_jax.tracing.Resolution(segments=..., panels=...), larger than the default"
)


def trace(
    scene: Scene, *, resolution: Resolution = Resolution(), tolerance: float = TABLE_TOL
) -> tuple[TracedPhase, ...]:
    """Trace every phase of a plan and tabulate its path dynamics.

    This solves the paper's "set of C-functions equated to zero" along the whole path (derivation, section 3).

    Args:
        scene: Scene with its plan.
        resolution: Sizes to begin with. Panels are doubled, up to 512, until a table is accurate; segments likewise.
            Within `jit` and `vmap` the sizes are fixed for a scene that is being transformed.
        tolerance: Interpolation error of the tables, relative to each function's size.

    Returns:
        One `TracedPhase` a phase. A phase that cannot be traced says so in `dynamics.status`; later ones are then
        meaningless.

    >>> traced = wa.trace(wa.load("heptagon"))
    >>> [wa.Status(int(phase.dynamics.status)).label for phase in traced]
    ['ok', 'ok']
    >>> print(f"{float(traced[0].dynamics.length):.2f} object radii")
    0.50 object radii
    """
    if is_traced(scene):
        return _trace_transformed(scene, resolution, tolerance)
    return _trace_numbers(scene, resolution, tolerance)


def _trace_transformed(scene: Scene, resolution: Resolution, tolerance: float) -> tuple[TracedPhase, ...]:
    """Trace a plan that is being transformed, in one program.

    Its sizes grow as in `_trace_refined` where its numbers are known, as under `grad`; within `jit` and `vmap` they are
    as given.
    """
    traced = refine_in_one_program(lambda sizes: trace_in_one_program(scene, sizes), resolution, tolerance)
    return unstack_trees(traced, len(scene.phases))


def refine_in_one_program(trace_stacked, resolution: Resolution, tolerance: float = TABLE_TOL):
    """Call `trace_stacked(resolution)` with larger sizes until they suffice, and return its result.

    Its result has stacked path dynamics as `dynamics`, which do not converge where the largest sizes do not suffice.
    Sizes that are being transformed are not judged.
    """
    while True:
        traced = trace_stacked(resolution)
        sizes = jax.lax.stop_gradient(_table_sizes(traced.dynamics))
        if is_traced(sizes):
            return traced
        full, coarse = map(np.asarray, insufficient(jax.device_get(sizes), resolution, tolerance))
        refined = _refine(resolution, bool(full.any()), bool(coarse.any()))
        if refined is None:
            status = np.where(full | coarse, int(Status.NO_CONVERGENCE), sizes.status)
            return eqx.tree_at(lambda t: t.dynamics.status, traced, as_device_array(status))
        if refined == resolution:
            return traced
        resolution = refined


class TableSizes(NamedTuple):
    """What tells whether a table's sizes suffice."""

    count: Int[Array, ""]  # segments in use
    error: Float[Array, ""]  # interpolation error, relative to each function's size
    status: Int[Array, ""]


def _table_sizes(dynamics: PathDynamics) -> TableSizes:
    return TableSizes(dynamics.count, dynamics.error, dynamics.status)


def insufficient(sizes: TableSizes, resolution: Resolution, tolerance: float):
    """Say whether a path uses up its segments, and whether its table is less accurate than `tolerance`."""
    error_floor = TABLE_ROUNDING * float(np.finfo(sizes.error.dtype).eps)
    inaccurate = sizes.error > max(tolerance, error_floor)
    return sizes.count >= resolution.segments, inaccurate & (sizes.status == int(Status.OK))


def refuse_coarse_tables(values, traced: tuple[TracedPhase, ...], resolution: Resolution):
    """Return `values`, or raise when the program runs and a table, whose sizes are fixed by then, does not suffice."""
    sizes = [_table_sizes(phase.dynamics) for phase in traced]
    bad = [full | coarse for full, coarse in (insufficient(one, resolution, TABLE_TOL) for one in sizes)]
    return eqx.error_if(values, jnp.stack(bad).any(), COARSE_TABLES) if is_traced(bad) else values


def _refine(resolution: Resolution, full: bool, coarse: bool) -> Resolution | None:
    """Return the next larger resolution, the same where it suffices, None where there is none."""
    if full and resolution.segments < MAX_SEGMENTS:
        return resolution._replace(segments=2 * resolution.segments, panels=2 * resolution.panels)
    if coarse and resolution.panels < MAX_PANELS:
        return resolution._replace(panels=2 * resolution.panels)
    return None if full or coarse else resolution


@computed_at_once
def _trace_numbers(scene: Scene, resolution: Resolution, tolerance: float) -> tuple[TracedPhase, ...]:
    """Trace a plan phase by phase, each with its own sizes."""
    body, initial_guess, traced_phases = rigid_body(scene.object), scene.start, []
    for phase in scene.phases:
        begin = initial_guess, as_device_array(not traced_phases)
        traced = _trace_refined(body, scene, phase, *begin, resolution, tolerance)
        if phase.arrive is Arrival.HOLD and int(traced.dynamics.status) != Status.OK:
            reversed_phase = eqx.tree_at(lambda p: p.target.sign, phase, -phase.target.sign)
            traced = _trace_refined(body, scene, reversed_phase, *begin, resolution, tolerance)
        traced_phases.append(traced)
        initial_guess = target_configuration(phase, traced)
    return tuple(traced_phases)


@eqx.filter_jit
def trace_in_one_program(scene: Scene, resolution: Resolution) -> TracedPhase:
    """Trace every phase of a plan in one program: a `TracedPhase` with a leading axis of phases."""
    body = rigid_body(scene.object)

    def trace_one(formation, *inputs):
        traced = trace_phase(body, scene.hand, scene.gravity, formation, *inputs)
        return traced, traced.begin, traced.end

    return _scan_phases(trace_one, scene, resolution)


def trace_paths_in_one_program(scene: Scene, resolution: Resolution) -> ContactPath:
    """Trace the paths of a plan without their tables: a `ContactPath` with a leading axis of phases."""
    body = rigid_body(scene.object)

    def trace_one(formation, *inputs):
        return trace_phase_path(scaled_mechanics(body, scene.hand, scene.gravity, formation), *inputs)

    return _scan_phases(trace_one, scene, resolution)


def _scan_phases(trace_one, scene: Scene, resolution: Resolution):
    """Scan over the phases of a plan, each traced from where the one before it ended.

    `trace_one(formation, initial_guess, target, resolution, first, holds)` returns a traced phase and `z` (SI) at its
    start and end.
    """

    def step(carry, phase):
        (initial_guess, first), (formation, target, holds) = carry, phase
        traced, begin, end = trace_one(formation, initial_guess, target, resolution, first, holds)
        return (jnp.where(holds, begin, end), jnp.asarray(False)), traced

    formations = alike_formations([p.formation for p in scene.phases])
    each = zip(formations, scene.phases, strict=True)
    phases = stack_trees([(one, p.target, jnp.asarray(p.arrive is Arrival.HOLD)) for one, p in each])
    return jax.lax.scan(step, (scene.start, jnp.asarray(True)), phases)[1]


def _trace_refined(
    body, scene: Scene, phase: Phase, initial_guess, first, resolution: Resolution, tolerance: float
) -> TracedPhase:
    """Trace one phase, with more segments and panels until they suffice; at their limits it does not converge."""
    inputs, holds = (phase.formation, initial_guess, phase.target), as_device_array(phase.arrive is Arrival.HOLD)
    while True:
        traced = trace_phase(body, scene.hand, scene.gravity, *inputs, resolution, first, holds)
        full, coarse = insufficient(jax.device_get(_table_sizes(traced.dynamics)), resolution, tolerance)
        refined = _refine(resolution, bool(full), bool(coarse))
        if refined is None:
            return eqx.tree_at(lambda t: t.dynamics.status, traced, jnp.asarray(int(Status.NO_CONVERGENCE), int))
        if refined == resolution:
            return traced
        resolution = refined
