"""The equations of motion along a path, tabulated, and impacts."""

from wholearm_jax.dynamics.path_dynamics import (
    Impact,
    PathDynamics,
    differentiate_polynomial,
    equations_of_motion,
    evaluate,
    evaluate_dot,
    evaluate_polynomial,
    locate_panel,
    placeholder_dynamics,
    resolve_impact,
    tabulate_path_dynamics,
)
