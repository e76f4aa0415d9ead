"""Disturb: an execution repeated with one thing wrong at a time, and where on a map of sizes it still succeeds.

Three kinds of thing go wrong: somebody pushes, by `size` at `time`; one link's friction is not what was thought; the
object lies beside where it should. Each map is a grid of executions, each judged by its own object's path.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from wholearm_jax.execution.executions import ExecutionOutcome
from wholearm_jax.execution.pushes import push
from wholearm_jax.execution.trials import Copy, PerturbedRun, run_copies
from wholearm_jax.model import COORDINATES, LINKS, Scene
from wholearm_jax.phases import Result


@dataclass(frozen=True)
class DisturbanceMap:
    """Executions over the sizes of a disturbance (rows) and over when or where it acts (columns).

    `kind` says what was changed, with the unit of `sizes`; `columns` are moments [s], links or coordinates. `runs` are
    row by row.
    """

    kind: str
    sizes: Float[np.ndarray, "sizes"]
    columns: tuple[float, ...] | tuple[str, ...]
    runs: tuple[PerturbedRun, ...]

    @property
    def succeeds(self) -> Bool[np.ndarray, "sizes columns"]:
        """Which executions end where their object's own path does."""
        good = [run.own_ending is ExecutionOutcome.OK for run in self.runs]
        return np.reshape(good, (len(self.sizes), len(self.columns)))

    @property
    def endings(self) -> tuple[tuple[str, ...], ...]:
        """What became of each, row by row."""
        names = [run.own_ending.value for run in self.runs]
        width = len(self.columns)
        return tuple(tuple(names[k : k + width]) for k in range(0, len(names), width))


def push_map(
    prediction: Result, coordinate: str, sizes: Sequence[float], times: Sequence[float], **settings: Any
) -> DisturbanceMap:
    """Push along one coordinate, by every one of `sizes` at every one of `times`.

    Args:
        prediction: the plan, as for `execute`.
        coordinate: "x", "y", "phi", "theta1" or "theta2".
        sizes: impulses [N s], about an axis [N m s].
        times: when each push begins [s].
        settings: those of `run_copies`: controller, hardware, seed, workers and so on.
    """
    kind = f"push along {coordinate} [N s]" if coordinate in ("x", "y") else f"push about {coordinate} [N m s]"
    copies = [
        Copy(prediction.scene, np.zeros(3), (push(time, **{coordinate: size}),)) for size in sizes for time in times
    ]
    return DisturbanceMap(kind, np.asarray(sizes, float), tuple(times), run_copies(prediction, copies, **settings))


def friction_map(prediction: Result, factors: Sequence[float], **settings: Any) -> DisturbanceMap:
    """Multiply the friction coefficient of one link at a time by every one of `factors`."""
    copies = [
        Copy(_with_friction(prediction.scene, link, factor), np.zeros(3))
        for factor in factors
        for link in range(len(LINKS))
    ]
    runs = run_copies(prediction, copies, **settings)
    return DisturbanceMap("friction, times", np.asarray(factors, float), LINKS, runs)


def start_map(prediction: Result, sizes: Sequence[float], **settings: Any) -> DisturbanceMap:
    """Lay the object beside its start, by every one of `sizes` [m] in x, in y and, at its farthest vertex, in phi.

    As in `run_trials` it is then laid into contact, at the nearest configuration whose first gaps are 0.
    """
    copies = [Copy(prediction.scene, size * np.eye(3)[k]) for size in sizes for k in range(3)]
    runs = run_copies(prediction, copies, **settings)
    return DisturbanceMap("start displaced [m]", np.asarray(sizes, float), COORDINATES[:3], runs)


def _with_friction(scene: Scene, link: int, factor: float) -> Scene:
    """Return the scene in which one link's friction with the object is multiplied."""
    factors = jnp.ones(len(LINKS)).at[link].set(factor)
    return eqx.tree_at(lambda s: s.object.friction, scene, jax.device_get(scene.object.friction * factors))
