"""Pushes: impulses that nobody planned, spread over a few milliseconds, on the free bodies of an execution."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import require_positive
from wholearm_jax.model import COORDINATES

LASTING = 0.01  # how long a push lasts [s]: about as long as a tap with a finger


class Push(NamedTuple):
    """An impulse from `time` [s] on, in equal parts over `duration` [s].

    `impulse` belongs to the coordinates `(x, y, phi, theta1, theta2)`: [N s] at the object's reference point along x
    and y, [N m s] about it and about the fingers' joints.
    """

    time: float
    impulse: Float[np.ndarray, "5"]
    duration: float = LASTING


def push(time: float, *, duration: float = LASTING, **impulse: float) -> Push:
    """Return the push with these impulses by coordinate, e.g. `push(0.4, x=0.002)`.

    Raises ValueError for a coordinate that is none, without an impulse, and for times that cannot be.
    """
    unknown = [name for name in impulse if name not in COORDINATES]
    if unknown or not impulse:
        raise ValueError(f"push: {', '.join(unknown) or 'nothing'}: the coordinates are {', '.join(COORDINATES)}")
    require_positive(duration=duration)
    values = np.array([float(impulse.get(name, 0.0)) for name in COORDINATES])
    if not (0 <= time < np.inf and np.isfinite(values).all()):
        raise ValueError(f"push at {time:g} s: its time must not be negative, its impulses finite")
    return Push(float(time), values, float(duration))


def push_force(pushes: Sequence[Push], timestep: float) -> Callable[[int], Float[np.ndarray, "5"]]:
    """Return the generalised force [N; N m] of all pushes in time step `k`, so that each gives its whole impulse."""
    first = [round(one.time / timestep) for one in pushes]
    count = [max(1, round(one.duration / timestep)) for one in pushes]
    force = [one.impulse / (n * timestep) for one, n in zip(pushes, count, strict=True)]
    return lambda k: sum((f for f, a, n in zip(force, first, count, strict=True) if a <= k < a + n), np.zeros(5))
