"""Phases one after the other: trace, simulate, assess, describe, sample, differentiate."""

from wholearm_jax.phases.assessment import ARRIVAL_SPEED_FACTOR, assess_phase
from wholearm_jax.phases.closed_loop import (
    CLOSED_LOOP_STEPS,
    CLOSED_LOOP_TOLERANCE,
    closed_loop_margin,
    closed_loop_options,
    ends_at_contact,
    initial_loop_carry,
    loop_step,
    require_phases,
    simulate_closed_loop,
)
from wholearm_jax.phases.closed_loop_result import closed_loop_result
from wholearm_jax.phases.compressive_margin import margin
from wholearm_jax.phases.contact_opening import IMPULSE_ROUNDING, MAX_OPENING, ContactOpening, contact_opening
from wholearm_jax.phases.gradients import check_gradient
from wholearm_jax.phases.hand_over_torques import OneSidedTorque, one_sided_torques
from wholearm_jax.phases.hand_overs import (
    STARTING,
    STOPPING,
    HandOver,
    find_hand_over,
    find_hand_overs,
    hand_over_contacts,
    may_hand_over,
    possible_hand_overs,
)
from wholearm_jax.phases.obstacles import describe_overlaps
from wholearm_jax.phases.phase_ends import (
    configuration,
    describe_end,
    ends_at_stop,
    final_configuration,
    formation_at_end,
    rest_terms,
    statics_at_start,
    target_configuration,
)
from wholearm_jax.phases.phase_groups import group_phases, starts_at_rest
from wholearm_jax.phases.phase_simulation import (
    SimulatedPhase,
    precompile_simulation,
    simulate_phase,
    simulate_with_enough_steps,
)
from wholearm_jax.phases.phase_tracing import TracedPhase, trace_phase
from wholearm_jax.phases.plan_schedule import (
    has_torque_jumps,
    note_on_length,
    require_covered,
    require_motion,
    with_plan_step_capacity,
)
from wholearm_jax.phases.plan_simulation import (
    initial_carry,
    phase_inputs,
    precompile_simulate,
    scan_step,
    simulate,
    simulate_phases,
)
from wholearm_jax.phases.plan_tracing import trace, trace_paths_in_one_program
from wholearm_jax.phases.rest_certificate import certify_rest
from wholearm_jax.phases.result import OPENING_ADVICE, PhaseResult, Result, build_result, rest_intervals
from wholearm_jax.phases.sampling import DEFAULT_SAMPLES, Trajectory, by_contact, sample_phase, trajectory
from wholearm_jax.phases.standing_fingers import idle_torques
from wholearm_jax.phases.torque_accuracy import END_ANGLE, END_POSITION, MOTOR_ERROR, required_accuracy, torque_accuracy
