"""Gradients of a plan's margin: with respect to the torques, and checked against differences.

`torque_gradient` takes the mode that costs less. Forward mode carries one direction for each torque; reverse mode goes
back through the steps once, however many directions there are (`benchmarks/gradients.py`).

`check_gradient` compares slopes of the margin along a random relative change of each group of inputs, at several
integration tolerances: forward mode, reverse mode and central differences. Differences are extrapolated twice
(Richardson) at a ladder of steps; the change from one step to the next estimates their error. Where the smallest force
changes its contact, the margin has a kink: differences straddle it, derivatives take one side. Where the differences'
error is too large to decide, the check says so.
"""

import itertools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wholearm_jax.core import require_x64
from wholearm_jax.model import Scene, TorqueSchedule
from wholearm_jax.phases.compressive_margin import margin, plan_margin
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.phases.plan_schedule import has_torque_jumps, with_plan_step_capacity
from wholearm_jax.phases.plan_simulation import simulate_phases
from wholearm_jax.phases.plan_tracing import trace
from wholearm_jax.simulation import Adjoint, IntegratorOptions, tolerance_as_data

MAX_FORWARD_DIRECTIONS = 2  # rows of a schedule up to which forward mode costs less
CHECKED_TOLERANCES = (1e-8, 1e-10, 1e-12)
DIFFERENCE_STEPS = tuple(1e-3 / 5**k for k in range(5))  # largest relative changes of the inputs
MODE_TOL = 1e-8  # relative difference at which forward and reverse mode agree
DIFFERENCE_TOL = 1e-5  # relative difference at which they agree with the differences, beyond their uncertainty
MAX_UNCERTAINTY = 1e-2  # relative error of the differences above which they cannot decide
MIN_SLOPE = 1e-9  # [N], smaller slopes count as zero


def torque_gradient(
    scene: Scene, torque: TorqueSchedule, *, traced: tuple[TracedPhase, ...] = (), tolerance: float = 1e-10
) -> tuple[Float[Array, ""], Float[Array, "rows 2"]]:
    """Compute the margin of a plan and its gradient with respect to the torques.

    Compiled once for every number of rows.

    Args:
        scene: Scene with its plan.
        torque: Schedule that covers the plan.
        traced: Result of `trace`, to reuse.
        tolerance: Tolerance of the integrator.

    Returns:
        The margin `m` [N] as by `margin`, and `dm/dtau` [1/m] at every row of the schedule.

    >>> from wholearm_jax.phases.gradients import torque_gradient
    >>> scene = wa.load("heptagon")
    >>> m, slope = torque_gradient(scene, wa.quasistatic(scene, knots=6))
    >>> slope.shape
    (12, 2)
    """
    require_x64(scene, torque)
    mode, jumps = choose_mode(torque), has_torque_jumps(scene, torque)
    options = IntegratorOptions(tolerance=tolerance, adjoint=mode, has_jumps=jumps)
    options = tolerance_as_data(with_plan_step_capacity(options, scene, torque), torque.times.dtype)
    return _margin_and_gradient(scene, torque, traced or trace(scene), options)


def choose_mode(torque: TorqueSchedule) -> Adjoint:
    """Return the mode that costs less for a schedule: forward or reverse."""
    return Adjoint.FORWARD if torque.times.shape[0] <= MAX_FORWARD_DIRECTIONS else Adjoint.REVERSE


@eqx.filter_jit
def _margin_and_gradient(scene, torque, traced, options):
    """Differentiate the margin in the mode that `options` name."""

    def value(values):
        m = plan_margin(scene, simulate_phases(scene, TorqueSchedule(torque.times, values), traced, options))
        return m, m

    derivative = jax.jacfwd if options.adjoint is Adjoint.FORWARD else jax.grad
    gradient, m = derivative(value, has_aux=True)(torque.values)
    return m, gradient


@dataclass(frozen=True)
class DirectionalDerivative:
    """Slope of the margin [N] along a relative change of a group of inputs, computed in three ways."""

    group: str
    tolerance: float  # of the integrator
    forward: float
    reverse: float
    differences: float
    uncertainty: float  # of the differences

    @property
    def finding(self) -> str:
        """Finding of the check.

        `agree`: the modes agree with one another and, within their uncertainty, with the differences; `unsure`: the
        modes agree, but the differences cannot decide; `differ`: otherwise.
        """
        size = max(abs(self.forward), abs(self.differences))
        modes_agree = abs(self.forward - self.reverse) <= MODE_TOL * size + MIN_SLOPE
        if modes_agree and self.uncertainty > MAX_UNCERTAINTY * size + MIN_SLOPE:
            return "unsure"
        error = abs(self.forward - self.differences)
        return (
            "agree" if modes_agree and error <= DIFFERENCE_TOL * size + 4 * self.uncertainty + MIN_SLOPE else "differ"
        )


def check_gradient(
    scene: Scene, torque: TorqueSchedule, *, tolerances: tuple[float, ...] = CHECKED_TOLERANCES, seed: int = 0
) -> tuple[DirectionalDerivative, ...]:
    """Check the derivatives of `margin` for each group of inputs: torques, object, hand, gravity and start.

    Args:
        scene: Scene with its plan.
        torque: Schedule that covers the plan.
        tolerances: Tolerances of the integrator.
        seed: Chooses the random directions.

    Returns:
        One `DirectionalDerivative` for each tolerance and group.

    Raises:
        ValueError: Where the plan has no margin to differentiate.
    """
    require_x64(scene, torque)
    floats, rest = eqx.partition((scene, torque), eqx.is_inexact_array)

    def value(inputs, tolerance, adjoint):
        # A tolerance that is an array is data: all tolerances share their programs.
        options = IntegratorOptions(tolerance=jnp.asarray(tolerance), adjoint=adjoint)
        return margin(*eqx.combine(inputs, rest), options=options)

    if not np.isfinite(float(value(floats, 1e-8, Adjoint.NONE))):
        raise ValueError("the plan has no margin to differentiate: simulate it to see why")
    derivatives = []
    for tolerance in tolerances:
        gradient = jax.grad(lambda inputs, tol=tolerance: value(inputs, tol, Adjoint.REVERSE))(floats)
        for name, tangent in _directions(floats, seed).items():
            _, forward = jax.jvp(
                lambda inputs, tol=tolerance: value(inputs, tol, Adjoint.FORWARD), (floats,), (tangent,)
            )
            pairs = zip(*map(jax.tree.leaves, (gradient, tangent)), strict=True)
            reverse = sum(float((g * d).sum()) for g, d in pairs)

            def along(h, tangent=tangent, tol=tolerance):
                return float(value(optax.tree.add_scale(floats, h, tangent), tol, Adjoint.NONE))

            uncertainty, slope = _most_stable([_richardson(along, step) for step in DIFFERENCE_STEPS])
            derivatives.append(DirectionalDerivative(name, tolerance, float(forward), reverse, slope, uncertainty))
    return tuple(derivatives)


def _directions(floats, seed: int):
    """Draw a random relative change of each group of inputs, as tangents of all inputs."""
    rng = np.random.default_rng(seed)
    tangents = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)) * a, floats)
    zeros = jax.tree.map(jnp.zeros_like, floats)
    groups = {
        "torques": lambda inputs: inputs[1].values,
        "object": lambda inputs: inputs[0].object,
        "hand": lambda inputs: inputs[0].hand,
        "gravity": lambda inputs: inputs[0].gravity,
        "start": lambda inputs: inputs[0].start,
    }
    return {name: eqx.tree_at(where, zeros, where(tangents)) for name, where in groups.items()}


def _most_stable(ladder: list[float]) -> tuple[float, float]:
    """Return the smallest change between neighbours of a ladder, and the value after it; no margin gives no value."""
    pairs = [(abs(fine - coarse), fine) for coarse, fine in itertools.pairwise(ladder)]
    return min((pair for pair in pairs if np.isfinite(pair[0])), default=(np.inf, np.nan))


def _richardson(function, largest: float) -> float:
    """Extrapolate central differences at three steps twice."""
    first, second, third = ((function(h) - function(-h)) / (2 * h) for h in (largest, largest / 2, largest / 4))
    return (16 * (4 * third - second) / 3 - (4 * second - first) / 3) / 15
