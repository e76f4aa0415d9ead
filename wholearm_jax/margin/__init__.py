"""Contact forces, their exact minimum over time, quasi-static torques, upper bounds, statics of rest."""

from wholearm_jax.margin.barrier_minimum import log_barrier_minimum
from wholearm_jax.margin.chain_interior_point import ChainEffort
from wholearm_jax.margin.contact_forces import (
    MAX_ROLLING,
    SAMPLES_PER_STEP,
    cone_facets,
    contact_force,
    force_slack,
    is_duplicate_facet,
    sampled_slacks,
)
from wholearm_jax.margin.exact_margin import MAX_REFINED, MarginResult, minimum_margin
from wholearm_jax.margin.path_optimum import (
    PROGRAMME_INTERVALS,
    PathOptimum,
    largest_margin,
    shortest_duration,
    solve_path,
)
from wholearm_jax.margin.path_programme import SpeedRange, rest_to_rest
from wholearm_jax.margin.quasistatic import (
    acceleration_terms,
    affine_coefficients,
    best_quasistatic_torque,
    best_quasistatic_torque_batch,
)
from wholearm_jax.margin.rest_interval import RestInterval, rest_margin, schedule_corners
from wholearm_jax.margin.statics import (
    MARGIN_TIE,
    MIN_REST_MARGIN,
    RestAccelerations,
    StaticMargin,
    Statics,
    contact_statics,
    without_joint,
)
from wholearm_jax.margin.strong_stability import moving_mode, must_stay
from wholearm_jax.margin.upper_bound import BOUND_PLACES, BOUND_SPEEDS, MAX_SPEED_RATIO, MarginBound, margin_upper_bound
