"""The equations of motion along a path, tabulated, and impacts."""

from wholearm_jax.dynamics.impact import Impact, resolve_impact
from wholearm_jax.dynamics.motion_equations import equations_of_motion
from wholearm_jax.dynamics.path_dynamics import PathDynamics, evaluate, evaluate_dot, locate_panel, placeholder_dynamics
from wholearm_jax.dynamics.polynomials import differentiate_polynomial, evaluate_polynomial, fit_panels
from wholearm_jax.dynamics.tabulation import tabulate_path_dynamics
