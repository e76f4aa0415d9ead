"""Phases one after the other: trace, simulate, assess, describe, sample, differentiate."""

from wholearm_jax.phases.assessment import ARRIVAL_SPEED_FACTOR, GOALS, IMPULSE_ROUNDING, assess_phase
from wholearm_jax.phases.gradient_check import check_gradient
from wholearm_jax.phases.phase import (
    SimulatedPhase,
    TracedPhase,
    describe_end,
    final_configuration,
    precompile_simulation,
    simulate_phase,
    statics_at_start,
    target_configuration,
    trace_phase,
)
from wholearm_jax.phases.plan import (
    has_torque_jumps,
    initial_carry,
    margin,
    phase_inputs,
    precompile_simulate,
    require_covered,
    require_motion,
    scan_step,
    simulate,
    simulate_phases,
    stack_trees,
    trace,
    trace_paths_in_one_program,
    unstack_trees,
    with_plan_step_capacity,
)
from wholearm_jax.phases.rest_certificate import certify_rest
from wholearm_jax.phases.result import Result, build_result, rest_intervals
from wholearm_jax.phases.sampling import DEFAULT_SAMPLES, sample_phase, trajectory
