"""The path of a contact formation: projection, continuation, events, segments."""

from wholearm_jax.tracing.path import (
    LEFT,
    MADE,
    UNTIL,
    ContactPath,
    Resolution,
    chebyshev_points,
    placeholder_path,
    trace_path,
)
from wholearm_jax.tracing.path_root import path_derivatives, solve_on_path
