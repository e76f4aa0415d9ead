"""Goals of a plan: the coordinates that matter, with tolerances."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wholearm_jax.model import COORDINATES

DEFAULT_TOLERANCE = {"x": 1e-3, "y": 1e-3, "phi": np.radians(1.0), "theta1": np.radians(1.0), "theta2": np.radians(1.0)}


@dataclass(frozen=True)
class Goal:
    """Values of some coordinates of `z` (SI), each with the distance from it that is good enough."""

    values: Mapping[str, float]
    tolerance: Mapping[str, float]

    def distance(self, z) -> np.ndarray:
        """Return the distance of configurations `(..., 5)` from the goal in each of its coordinates (..., goals)."""
        return np.abs(np.asarray(z)[..., self._rows] - self._aims)

    def is_reached(self, z) -> bool:
        """Whether a configuration is within all tolerances."""
        return bool((self.distance(z) <= self.limits).all())

    @functools.cached_property
    def limits(self) -> np.ndarray:
        """The tolerances of its coordinates, in their order."""
        return np.array([self.tolerance[name] for name in self.values])

    @functools.cached_property
    def _aims(self) -> np.ndarray:
        return np.array([*self.values.values()])

    @functools.cached_property
    def _rows(self) -> np.ndarray:
        return np.array([COORDINATES.index(name) for name in self.values])


def make_goal(
    start,
    goal: Mapping[str, float] | None = None,
    *,
    by: Mapping[str, float] | None = None,
    tolerance: Mapping[str, float] | None = None,
) -> Goal:
    """Build a goal from absolute values and displacements from a start.

    Args:
        start: `z` (5,), SI.
        goal: absolute values of coordinates.
        by: displacements of further coordinates.
        tolerance: distances that are good enough; 1 mm and 1 degree unless given.

    Raises:
        ValueError: for a goal without coordinates, unknown names, or a coordinate that is given twice.
    """
    goal, by, tolerance = dict(goal or {}), dict(by or {}), dict(tolerance or {})
    unknown = [name for name in (*goal, *by, *tolerance) if name not in COORDINATES]
    if unknown:
        raise ValueError(f"goal: '{unknown[0]}' is not a coordinate; these are: {', '.join(COORDINATES)}")
    twice = goal.keys() & by.keys()
    if twice:
        raise ValueError(f"goal: {min(twice)} is given twice, absolute and relative")
    if not goal and not by:
        raise ValueError("goal: give at least one coordinate, such as x = -0.03 or, relative, by phi = -0.7")
    values = goal | {name: float(start[COORDINATES.index(name)]) + change for name, change in by.items()}
    if (
        not all(np.isfinite(v) for v in (*values.values(), *tolerance.values()))
        or min(tolerance.values(), default=1) <= 0
    ):
        raise ValueError("goal: values must be finite, tolerances positive")
    ordered = {name: float(values[name]) for name in COORDINATES if name in values}
    return Goal(ordered, {name: float((DEFAULT_TOLERANCE | tolerance)[name]) for name in ordered})
