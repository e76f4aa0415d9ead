"""What a scene is: polygon, hand, contact formation, contact kinematics, scaling, torque schedule."""

from wholearm_jax.model.hand_choice import HandChoice, choose_hand, resting_edges, scaled_hand
from wholearm_jax.model.hand_collisions import LINK_OBSTACLES, LinkMeeting, link_obstacles, link_overlaps
from wholearm_jax.model.kinematics import (
    CORNER_TOL,
    FEATURE_GROUPS,
    FINGER_ROOT,
    PALM_END,
    Carrier,
    ContactKinematics,
    ContactSet,
    anchor_rolling,
    constraint_jacobian,
    constraint_second_derivative,
    constraint_velocity,
    constraints,
    contact_candidates,
    contact_kinematics,
    contact_set,
    contact_velocity,
    gaps,
    normal_jacobian,
    slip_velocity,
    tangential_jacobian,
)
from wholearm_jax.model.law_tables import LawTables, PhaseTables
from wholearm_jax.model.mechanics import ScaledMechanics, configuration_unit, scaled_mechanics
from wholearm_jax.model.outline import find_defect, remains_simple
from wholearm_jax.model.regrasp import CONSTRAINTS, hold_contacts, regrasp_finger, regrasp_toward
from wholearm_jax.model.resting import edge_on_palm, resting_angle, resting_configuration
from wholearm_jax.model.scene import (
    ANGLE_COORDINATES,
    AWAY,
    AWAY_NAMES,
    COORDINATES,
    EDGE,
    LINKS,
    VERTEX,
    Arrival,
    ContactFormation,
    Hand,
    PathTarget,
    Phase,
    Polygon,
    RigidBody,
    Scene,
    alike_formations,
    contact_formation,
    contact_name,
    feature_pair,
    next_vertex,
    object_radius,
    parse_contact,
    path_target,
    polygon,
    replace_duration,
    rigid_body,
)
from wholearm_jax.model.schedule import (
    TIME_ROUNDING,
    PhaseSchedule,
    TorqueSchedule,
    concatenate_schedules,
    find_schedule_defect,
    has_jumps,
    interval,
    limit_violations,
    pad_schedule,
    restrict_to_phase,
    round_up,
    time_tolerance,
    torque_at,
    torque_schedule,
    uniform_schedule,
)
