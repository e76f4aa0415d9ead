"""Contact forces, their exact minimum over time, quasi-static torques, upper bounds, statics of rest."""

from wholearm_jax.margin.contact_forces import (
    MAX_ROLLING,
    DenseOutput,
    MarginResult,
    cone_facets,
    contact_force,
    dense_output,
    evaluate_dense,
    force_slack,
    is_duplicate_facet,
    log_barrier_minimum,
    minimum_margin,
    quintic_hermite,
    sampled_slacks,
)
from wholearm_jax.margin.quasistatic import (
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
