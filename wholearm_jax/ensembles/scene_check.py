"""Check of one scene under any JAX transformation: trace, tabulate, simulate and assess every phase of its plan."""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status, stack_trees
from wholearm_jax.dynamics import PathDynamics, tabulate_path_dynamics
from wholearm_jax.model import (
    ContactFormation,
    LawTables,
    Scene,
    TorqueSchedule,
    alike_formations,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.phases import (
    Result,
    SimulatedPhase,
    certify_rest,
    ends_at_contact,
    final_configuration,
    initial_carry,
    initial_loop_carry,
    loop_step,
    phase_inputs,
    scan_step,
    trace_paths_in_one_program,
)
from wholearm_jax.simulation import IntegratorOptions, phase_loop
from wholearm_jax.tracing import ContactPath, Resolution


class BatchResult(NamedTuple):
    """Outcome of checked scenes; leading axes run over the scenes."""

    status: Int[Array | np.ndarray, "*scenes"]  # `Status` value: that of the first phase that is not ok
    margin: Float[Array | np.ndarray, "*scenes"]  # [N], minimum over the plan; -inf where a phase has no motion
    time: Float[Array | np.ndarray, "*scenes"]  # [s], of the failure, or of the minimum where there is none
    contact: Int[Array | np.ndarray, "*scenes"]  # row of the phase's `ContactFormation.names`; -1: none
    phase: Int[Array | np.ndarray, "*scenes"]  # of the failure, or of the minimum where there is none
    end: Float[Array | np.ndarray, "*scenes 5"]  # `z` (SI) at the end of the failed or last phase; NaN without a path


class NextPass(IntEnum):
    """What a scene needs after a pass: nothing, a pass at a finer resolution, or `simulate` for this scene alone."""

    DONE = 0
    REFINE = 1
    SINGLE = 2


class Fidelity(NamedTuple):
    """Resolution of a pass, its integrator options, and the table error up to which its results count."""

    resolution: Resolution
    options: IntegratorOptions
    max_error: float


COARSE_PASS = Fidelity(Resolution(4, 7, 8, 64), IntegratorOptions(tolerance=1e-8, max_steps=96, max_stages=4), 5e-7)
FINE_PASS = Fidelity(Resolution(), IntegratorOptions(), 1e-9)


class _PhaseCheck(NamedTuple):
    """Check of one phase: status, time and contact of its end, its margin, and whether this pass settles them."""

    status: Int[Array, ""]
    margin: Float[Array, ""]  # [N]
    margin_time: Float[Array, ""]  # [s]
    margin_contact: Int[Array, ""]
    time: Float[Array, ""]  # [s]
    contact: Int[Array, ""]
    end: Float[Array, "5"]  # `z` (SI)
    is_accurate: Bool[Array, ""]  # the table is fine enough, and neither steps nor segments are used up
    rest_certified: Bool[Array, ""]  # friction provably holds the object wherever it rests


def check_scene(
    scene: Scene, schedule: TorqueSchedule | LawTables, arrival, fidelity: Fidelity
) -> tuple[BatchResult, Int[Array, ""]]:
    """Check one scene at one fidelity.

    Args:
        scene: Scene whose phases all move the object.
        schedule: Padded torque schedule (`model.pad_schedule`), or closed-loop law.
        arrival: Distance from the path's end within which a phase must end, as a fraction of the path's length.
        fidelity: `COARSE_PASS` or `FINE_PASS`, with `has_jumps` set as the schedule requires.

    Returns:
        The result, and the `NextPass` that the scene needs.
    """
    paths = trace_paths_in_one_program(scene, fidelity.resolution)
    return check_on_paths(scene, paths, schedule, arrival, fidelity)


def check_on_paths(
    scene: Scene, paths: ContactPath, schedule: TorqueSchedule | LawTables, arrival, fidelity: Fidelity
) -> tuple[BatchResult, Int[Array, ""]]:
    """Check one scene whose `paths`, stacked over its phases, are traced."""
    body = rigid_body(scene.object)

    def check_phase(carry, phase):
        path, tables, inputs, formation = phase
        mechanics = scaled_mechanics(body, scene.hand, scene.gravity, formation)
        dynamics = tabulate_path_dynamics(mechanics, path)
        if isinstance(schedule, LawTables):
            actuation = phase_loop(schedule, tables, dynamics)
            one = dynamics, actuation, tables, ends_at_contact(path), *inputs
            carry, simulated = loop_step(schedule, fidelity.options, arrival, carry, one)
        else:
            actuation = schedule
            carry, simulated = scan_step(schedule, fidelity.options, arrival, carry, (dynamics, *inputs))
        certified = certify_rest(mechanics, dynamics, actuation, simulated)
        return carry, _summarise_phase(dynamics, simulated, formation, fidelity, certified)

    formations = alike_formations([p.formation for p in scene.phases])
    phases = stack_trees([(phase_inputs(p), one) for p, one in zip(scene.phases, formations, strict=True)])
    if isinstance(schedule, LawTables):
        tables, carry = schedule.phases, initial_loop_carry(schedule)
    else:
        tables, carry = None, initial_carry(schedule)
    _, checks = jax.lax.scan(check_phase, carry, (paths, tables, *phases))
    return _combine_phases(checks, len(scene.phases))


def _summarise_phase(
    dynamics: PathDynamics, simulated: SimulatedPhase, formation: ContactFormation, fidelity: Fidelity, certified
) -> _PhaseCheck:
    """Reduce a simulated phase to its check; without a path, its margin and end are unknown."""
    motion, result, assessment = simulated.motion, simulated.margin_result, simulated.assessment
    has_path = dynamics.status == 0
    contact_of_row = jnp.cumsum(~formation.tangential) - 1
    ended = (assessment.status != int(Status.MAX_STEPS)) & (assessment.status != int(Status.NO_CONVERGENCE))
    resolved = (dynamics.error <= fidelity.max_error) & (dynamics.count < fidelity.resolution.segments)
    return _PhaseCheck(
        status=assessment.status,
        margin=jnp.where(jnp.isfinite(result.margin) & has_path, result.margin, -jnp.inf),
        margin_time=simulated.start + simulated.duration * result.phase_time,
        margin_contact=contact_of_row[result.contact],
        time=simulated.start + simulated.duration * assessment.phase_time,
        contact=jnp.where(assessment.contact >= 0, contact_of_row[assessment.contact], -1),
        end=jnp.where(has_path, final_configuration(dynamics, motion), jnp.nan),
        is_accurate=jnp.where(has_path, resolved & ended, ended),
        rest_certified=certified | ~has_path,
    )


def _combine_phases(checks: _PhaseCheck, count: int) -> tuple[BatchResult, Int[Array, ""]]:
    """Combine the checks of `count` phases: the first failure decides, without one the smallest margin."""
    failures = checks.status != int(Status.OK)
    failed = failures.any()
    decisive = jnp.where(failed, jnp.argmax(failures), jnp.argmin(checks.margin))
    last = jnp.where(failed, decisive, count - 1)
    result = BatchResult(
        status=checks.status[decisive],
        margin=checks.margin.min(),
        time=jnp.where(~failed, checks.margin_time, checks.time)[decisive],
        contact=jnp.where(~failed, checks.margin_contact, checks.contact)[decisive],
        phase=decisive,
        end=checks.end[last],
    )
    # Phases after a failure matter only for the margin, and there only if they have one.
    matters = jnp.arange(count) <= last
    has_margin = checks.status != int(Status.NO_CONVERGENCE)
    refine = jnp.any(~checks.is_accurate & (matters | has_margin))
    # Where only a linear programme can tell whether friction holds a rest, `simulate` must decide.
    single = jnp.any(~checks.rest_certified & matters)
    choices = [int(NextPass.REFINE), int(NextPass.SINGLE)]
    return result, jnp.select([refine, single], choices, int(NextPass.DONE))


def from_result(result: Result) -> BatchResult:
    """Express a simulated plan as the result of a check of one scene."""
    phases = list(result.phases)
    failed = next((k for k, p in enumerate(phases) if p.status is not Status.OK), None)
    decisive = int(np.argmin([p.margin for p in phases])) if failed is None else failed
    last = phases[-1 if failed is None else failed]
    phase = phases[decisive]
    contact = phase.margin_contact if failed is None else phase.contact
    dynamics, motion = last.traced.dynamics, last.outcome.motion
    end = final_configuration(dynamics, motion) if int(dynamics.status) == Status.OK else jnp.full(5, jnp.nan)
    return BatchResult(
        status=np.asarray(int(result.status)),
        margin=np.asarray(result.margin),
        time=np.asarray(phase.margin_time if failed is None else phase.time),
        contact=np.asarray(phase.contacts.index(contact) if contact else -1),
        phase=np.asarray(decisive),
        end=np.asarray(end),
    )
