"""Contact forces, their exact minimum over time, quasi-static torques, upper bounds, statics of rest."""

from wholearm_jax.margin.contact_forces import (
    MAX_REFINED,
    MAX_ROLLING,
    SAMPLES_PER_STEP,
    MarginResult,
    cone_facets,
    contact_force,
    force_slack,
    is_duplicate_facet,
    log_barrier_minimum,
    minimum_margin,
    sampled_slacks,
)
from wholearm_jax.margin.quasistatic import (
    BOUND_PLACES,
    BOUND_SPEEDS,
    MAX_SPEED_RATIO,
    MarginBound,
    acceleration_terms,
    affine_coefficients,
    best_quasistatic_torque,
    best_quasistatic_torque_batch,
    margin_upper_bound,
)
from wholearm_jax.margin.statics import (
    MARGIN_TIE,
    RestAccelerations,
    RestInterval,
    Statics,
    contact_statics,
    rest_margin,
)
