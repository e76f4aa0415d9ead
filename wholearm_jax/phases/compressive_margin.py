"""Compressive margin of a plan as one differentiable number."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import eval_context
from jaxtyping import Array, Float

from wholearm_jax.core import is_traced
from wholearm_jax.model import Arrival, Scene, TorqueSchedule
from wholearm_jax.phases.margin_gradient import margin_and_gradient
from wholearm_jax.phases.phase_simulation import SimulatedPhase
from wholearm_jax.phases.plan_schedule import has_torque_jumps, require_followable, with_plan_step_capacity
from wholearm_jax.phases.plan_simulation import simulate_phases
from wholearm_jax.phases.plan_tracing import refuse_coarse_tables, trace
from wholearm_jax.simulation import Adjoint, IntegratorOptions
from wholearm_jax.tracing import Resolution

MIN_FLOAT32_TOLERANCE = 1e-5  # of the integrator: float32 cannot meet less


def margin(
    scene: Scene,
    torque: TorqueSchedule,
    *,
    options: IntegratorOptions = IntegratorOptions(adjoint=Adjoint.BOTH),
    resolution: Resolution = Resolution(),
) -> Float[Array, ""]:
    """Compute the compressive margin of a plan, formations assumed to hold.

    It is the minimum over time and contacts of `c_n` and, for contacts that roll, of `mu c_n - |c_t|`: the paper's
    `c_n > 0` (section 2.2; derivation, sections 4 and 7). Phases that hold the object do not count. Differentiable, in
    forward and reverse mode, with respect to the torques and every float of the scene. In float32 it has four digits
    (`docs/accuracy.md`), and the integrator's tolerance is at least 1e-5.

    Args:
        scene: Scene with its plan.
        torque: Schedule that covers the plan.
        options: Integrator options. Jumps of the schedule within a phase are found where its times and the durations
            are numbers; where they are transformed, set `has_jumps`.
        resolution: Sizes of the paths and their tables, to begin with. They grow as needed, except for a scene that is
            an argument within `jit` or `vmap`: there an error says that they do not suffice.

    Returns:
        The margin [N]: negative where a contact would pull, `-inf` where a phase has no motion or no path. Whether the
        plan succeeds is for `simulate` to say.

    Raises:
        ValueError: For a schedule that is not finite or not sorted, naming the row, and for a plan that only holds its
            object.

    >>> scene = wa.load("heptagon")
    >>> print(f"{float(wa.margin(scene, wa.quasistatic(scene))):.2f} N")
    0.41 N
    """
    require_followable(torque)
    jumps = options.has_jumps or has_torque_jumps(scene, torque)
    options = replace(with_plan_step_capacity(options, scene, torque), has_jumps=jumps)
    if torque.times.dtype == jnp.float32:
        options = _coarsen(options)
    # Where the inputs are numbers and only the margin is differentiated, other programs give the derivative.
    compute = _margin if options.adjoint is Adjoint.BOTH else _margin_in_programs
    return compute(scene, torque, options=options, resolution=resolution)


def _margin_in_programs(scene: Scene, torque: TorqueSchedule, *, options: IntegratorOptions, resolution: Resolution):
    """Trace and simulate the plan."""
    traced = trace(scene, resolution=resolution)
    value = plan_margin(scene, simulate_phases(scene, torque, traced, options))
    return refuse_coarse_tables(value, traced, resolution) if is_traced(scene) else value


_margin = eqx.filter_custom_jvp(_margin_in_programs)


@_margin.def_jvp
def _slope(inputs, tangents, *, options: IntegratorOptions, resolution: Resolution):
    """Compute the margin and its slope along `tangents`, which are None where there are none."""
    if is_traced(inputs):
        return eqx.filter_jvp(partial(_margin_in_programs, options=options, resolution=resolution), inputs, tangents)
    with eval_context():  # of numbers, as outside of the derivative: programs are shared
        value, gradient = margin_and_gradient(inputs, tangents, options, resolution)
    return value, _sum_of_products(jax.tree.leaves(gradient), jax.tree.leaves(tangents))


@jax.jit
def _sum_of_products(gradient: list[Array], tangents: list[Array]) -> Float[Array, ""]:
    """Return the slope along `tangents`: one program for all leaves, and one for its transpose."""
    parts = [(slope * tangent).sum() for slope, tangent in zip(gradient, tangents, strict=True)]
    return jnp.stack(parts).sum()


def _coarsen(options: IntegratorOptions) -> IntegratorOptions:
    """Raise a tolerance that float32 cannot meet."""
    tolerance = options.tolerance
    number = isinstance(tolerance, float)
    least = max(tolerance, MIN_FLOAT32_TOLERANCE) if number else jnp.maximum(tolerance, MIN_FLOAT32_TOLERANCE)
    return replace(options, tolerance=least)


def plan_margin(scene: Scene, simulated: tuple[SimulatedPhase, ...]) -> Float[Array, ""]:
    """Return the smallest margin [N] of simulated phases, those that hold left out; `-inf` where one has no motion.

    Raises ValueError for a plan that only holds its object.
    """
    pairs = zip(simulated, scene.phases, strict=True)
    margins = [s.margin_result.margin for s, phase in pairs if phase.arrive is not Arrival.HOLD]
    if not margins:
        raise ValueError("a plan that only holds its object has no margin of a motion, see Result.hold_margin")
    return jnp.stack([jnp.where(jnp.isfinite(m), m, -jnp.inf) for m in margins]).min()
