"""Check the margin's derivatives on one's own scene: forward mode, reverse mode and differences, side by side.

Along a random relative change of each group of inputs (the torques, the object, the hand, gravity, the start) the
margin's slope is computed three ways at each of a ladder of integration tolerances. Differences are central ones
extrapolated twice (Richardson), of a ladder of steps those that change least from one to the next, and carry that
change as an estimate of their own error. Where the least force changes its contact, the margin has a kink: differences
straddle what derivatives take one side of. Where their error is too large to tell, the check says so.
"""

import itertools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from wholearm_jax.core import require_x64
from wholearm_jax.model import Scene, TorqueSchedule
from wholearm_jax.phases.plan import margin
from wholearm_jax.simulation import IntegratorOptions

TOLERANCES = (1e-8, 1e-10, 1e-12)
STEPS = tuple(1e-3 / 5**k for k in range(5))  # largest relative changes of the inputs for differences
MODES = 1e-8  # relative difference at which forward and reverse mode agree
NEAR = 1e-5  # relative difference at which they agree with the differences, beside their uncertainty
TELLING = 1e-2  # relative error of the differences above which they cannot tell
LEAST = 1e-9  # slopes smaller than this [N] count as nothing


@dataclass(frozen=True)
class DirectionalDerivative:
    """The margin's slope [N] along a relative change of a group of inputs, three ways, and what the differences may be
    off by."""

    group: str
    tolerance: float
    forward: float
    reverse: float
    differences: float
    uncertainty: float

    @property
    def finding(self) -> str:
        """`agree`: the modes with one another and, within their uncertainty, with the differences; `unsure`: the modes
        do, but the differences cannot tell; or `differ`."""
        size = max(abs(self.forward), abs(self.differences))
        modes = abs(self.forward - self.reverse) <= MODES * size + LEAST
        if modes and self.uncertainty > TELLING * size + LEAST:
            return "unsure"
        near = abs(self.forward - self.differences) <= NEAR * size + 4 * self.uncertainty + LEAST
        return "agree" if modes and near else "differ"


def check_gradient(
    scene: Scene, torque: TorqueSchedule, *, tolerances: tuple[float, ...] = TOLERANCES, seed: int = 0
) -> tuple[DirectionalDerivative, ...]:
    """Slopes of `margin` for each group of inputs and each of `tolerances`.

    Raises ValueError where the plan has no margin to differentiate.
    """
    require_x64()
    floats, rest = eqx.partition((scene, torque), eqx.is_inexact_array)

    def value(inputs, tolerance, adjoint):
        # A tolerance that is an array is data: all tolerances share their programs.
        options = IntegratorOptions(tolerance=jnp.asarray(tolerance), adjoint=adjoint)
        return margin(*eqx.combine(inputs, rest), options=options)

    if not np.isfinite(float(value(floats, 1e-8, "none"))):
        raise ValueError("the plan has no margin to differentiate: simulate it to see why")
    found = []
    for tolerance in tolerances:
        gradient = jax.grad(lambda inputs, at=tolerance: value(inputs, at, "both"))(floats)
        for name, way in _directions(floats, seed).items():
            forward = jax.jvp(lambda inputs, at=tolerance: value(inputs, at, "forward"), (floats,), (way,))[1]
            reverse = sum(float((g * d).sum()) for g, d in zip(*map(jax.tree.leaves, (gradient, way)), strict=True))

            def along(h, way=way, at=tolerance):
                return float(value(optax.tree.add_scale(floats, h, way), at, "none"))

            ladder = [_richardson(along, step) for step in STEPS]
            change, best = _steadiest(ladder)
            found.append(DirectionalDerivative(name, tolerance, float(forward), reverse, best, change))
    return tuple(found)


def _directions(floats, seed: int):
    """A random relative change of each group, as tangents of all inputs."""
    rng = np.random.default_rng(seed)
    whole = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)) * a, floats)
    still = jax.tree.map(jnp.zeros_like, floats)
    groups = {
        "torques": lambda inputs: inputs[1].values,
        "object": lambda inputs: inputs[0].object,
        "hand": lambda inputs: inputs[0].hand,
        "gravity": lambda inputs: inputs[0].gravity,
        "start": lambda inputs: inputs[0].start,
    }
    return {name: eqx.tree_at(where, still, where(whole)) for name, where in groups.items()}


def _steadiest(ladder: list[float]) -> tuple[float, float]:
    """The least change from one step of a ladder to the next, and where that leads; where a step leads to no margin it
    tells nothing."""
    pairs = [(abs(fine - initial_guess), fine) for initial_guess, fine in itertools.pairwise(ladder)]
    return min((pair for pair in pairs if np.isfinite(pair[0])), default=(np.inf, np.nan))


def _richardson(function, largest: float) -> float:
    """Central differences at three steps, extrapolated twice."""
    first, second, third = ((function(h) - function(-h)) / (2 * h) for h in (largest, largest / 2, largest / 4))
    return (16 * (4 * third - second) / 3 - (4 * second - first) / 3) / 15
