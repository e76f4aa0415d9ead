"""Gradient: the margin and its derivatives with respect to the torques, in the mode that costs less.

Forward mode carries one direction for each torque, reverse mode goes back through the steps once, however many there
are. Measured (`benchmarks/gradients.py`), the first is cheaper for schedules of up to `MAX_FORWARD_DIRECTIONS` rows.
"""

import equinox as eqx
import jax
from jaxtyping import Array, Float

from wholearm_jax.core import require_x64
from wholearm_jax.model import Scene, TorqueSchedule
from wholearm_jax.phases.phase import TracedPhase
from wholearm_jax.phases.plan import has_torque_jumps, plan_margin, simulate_phases, trace, with_plan_step_capacity
from wholearm_jax.simulation import IntegratorOptions, tolerance_as_data

MAX_FORWARD_DIRECTIONS = 2


def torque_gradient(
    scene: Scene, torque: TorqueSchedule, *, traced: tuple[TracedPhase, ...] = (), tolerance: float = 1e-10
) -> tuple[Float[Array, ""], Float[Array, "rows 2"]]:
    """The margin `m` [N] of a plan as by `plan.margin`, and `dm/dtau` [1/m] at every row of its schedule.

    `traced` reuses the result of `trace`, `tolerance` is the integrator's. Compiled once for every number of rows.

    >>> from wholearm_jax.phases.gradients import torque_gradient
    >>> scene = wa.load("heptagon")
    >>> m, slope = torque_gradient(scene, wa.quasistatic(scene, knots=6))
    >>> slope.shape
    (12, 2)
    """
    require_x64()
    options = IntegratorOptions(
        tolerance=tolerance, adjoint=choose_mode(torque), has_jumps=has_torque_jumps(scene, torque)
    )
    options = tolerance_as_data(with_plan_step_capacity(options, scene, torque), torque.times.dtype)
    return _gradient(scene, torque, traced or trace(scene), options)


def choose_mode(torque: TorqueSchedule) -> str:
    """`"forward"` or `"reverse"`: the mode that costs less for a schedule."""
    return "forward" if torque.times.shape[0] <= MAX_FORWARD_DIRECTIONS else "reverse"


@eqx.filter_jit
def _gradient(scene, torque, traced, options):
    def value(values):
        m = plan_margin(scene, simulate_phases(scene, TorqueSchedule(torque.times, values), traced, options))
        return m, m

    derivative = jax.jacfwd if options.adjoint == "forward" else jax.grad
    slope, m = derivative(value, has_aux=True)(torque.values)
    return m, slope
