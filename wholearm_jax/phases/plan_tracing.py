"""Tracing of a plan: every phase from where the one before it ended, refined until its tables are accurate."""

import equinox as eqx
import jax
import jax.numpy as jnp

from wholearm_jax.core import Status, as_device_array, is_traced, stack_trees, unstack_trees
from wholearm_jax.model import Arrival, Phase, Scene, rigid_body, scaled_mechanics
from wholearm_jax.phases.phase_ends import target_configuration
from wholearm_jax.phases.phase_tracing import TracedPhase, trace_phase, trace_phase_path
from wholearm_jax.tracing import ContactPath, Resolution

TABLE_ROUNDING = 1e4  # in units of machine epsilon, interpolation error that more panels do not reduce
MAX_PANELS = 512
MAX_SEGMENTS = 48


def trace(scene: Scene, *, resolution: Resolution = Resolution(), tolerance: float = 1e-9) -> tuple[TracedPhase, ...]:
    """Trace every phase of a plan and tabulate its path dynamics.

    This solves the paper's "set of C-functions equated to zero" along the whole path (derivation, section 3).

    Args:
        scene: Scene with its plan.
        resolution: Sizes to begin with. Panels are doubled, up to 512, until a table is accurate; segments likewise.
        tolerance: Interpolation error of the tables, relative to each function's size.

    Returns:
        One `TracedPhase` a phase. A phase that cannot be traced says so in `dynamics.status`; later ones are then
        meaningless.

    >>> traced = wa.trace(wa.load("heptagon"))
    >>> [wa.Status(int(phase.dynamics.status)).label for phase in traced]
    ['ok', 'ok']
    >>> print(f"{float(traced[0].dynamics.length):.2f} object radii")
    1.33 object radii
    """
    if is_traced(scene):  # shapes are fixed there: the caller has chosen the resolution
        return unstack_trees(trace_in_one_program(scene, resolution), len(scene.phases))
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

    phases = stack_trees([(p.formation, p.target, jnp.asarray(p.arrive is Arrival.HOLD)) for p in scene.phases])
    return jax.lax.scan(step, (scene.start, jnp.asarray(True)), phases)[1]


def _trace_refined(
    body, scene: Scene, phase: Phase, initial_guess, first, resolution: Resolution, tolerance: float
) -> TracedPhase:
    """Trace one phase, with more segments and panels until they suffice; at their limits it does not converge."""
    inputs, holds = (phase.formation, initial_guess, phase.target), as_device_array(phase.arrive is Arrival.HOLD)
    while True:
        traced = trace_phase(body, scene.hand, scene.gravity, *inputs, resolution, first, holds)
        dynamics = traced.dynamics
        error_floor = TABLE_ROUNDING * jnp.finfo(dynamics.breakpoints.dtype).eps
        coarse = float(dynamics.error) > max(tolerance, error_floor) and int(dynamics.status) == Status.OK
        full = int(dynamics.count) >= resolution.segments
        if full and resolution.segments < MAX_SEGMENTS:
            resolution = resolution._replace(segments=2 * resolution.segments, panels=2 * resolution.panels)
        elif coarse and resolution.panels < MAX_PANELS:
            resolution = resolution._replace(panels=2 * resolution.panels)
        elif coarse or full:
            return eqx.tree_at(lambda t: t.dynamics.status, traced, jnp.asarray(int(Status.NO_CONVERGENCE), int))
        else:
            return traced
