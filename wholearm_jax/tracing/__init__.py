"""The path of a contact formation: projection, continuation, events, segments."""

from wholearm_jax.tracing.corners import feature_clearance, hold_same_tip, pivot_clearance, run_into_object
from wholearm_jax.tracing.path import ContactPath, PathEnd, Resolution, chebyshev_points, placeholder_path
from wholearm_jax.tracing.path_root import path_derivatives, solve_on_path
from wholearm_jax.tracing.start_checks import lie_before_link
from wholearm_jax.tracing.trace import trace_path
