"""Quantities of a scene that an ensemble may vary, and the spreads that leave every drawn scene a valid one."""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from wholearm_jax.model import COORDINATES, LINKS, Scene, remains_simple

FINGERS = ("finger 1", "finger 2")


class Quantity(NamedTuple):
    """Floats of a scene that may vary.

    `where` selects them, `entries` names the entries of an array, and `allowed` says which values a scene accepts.
    """

    where: Callable
    entries: tuple[str, ...] | None = None
    allowed: Literal["any", "positive", "not negative"] = "any"


QUANTITIES = {
    "vertices": Quantity(lambda s: s.object.vertices),
    "mass": Quantity(lambda s: s.object.mass, allowed="positive"),
    "friction": Quantity(lambda s: s.object.friction, LINKS, "not negative"),
    "inertia": Quantity(lambda s: s.object.inertia, allowed="positive"),
    "center_of_mass": Quantity(lambda s: s.object.center_of_mass, ("x", "y")),
    "joint": Quantity(lambda s: s.hand.joint, tuple(f"{f} {c}" for f in FINGERS for c in "xy")),
    "length": Quantity(lambda s: s.hand.length, FINGERS, "positive"),
    "offset": Quantity(lambda s: s.hand.offset, FINGERS),
    "back": Quantity(lambda s: s.hand.back, FINGERS, "not negative"),
    "range": Quantity(lambda s: s.hand.range, tuple(f"{f} {end}" for f in FINGERS for end in ("least", "largest"))),
    "finger_inertia": Quantity(lambda s: s.hand.inertia, FINGERS, "positive"),
    "viscous": Quantity(lambda s: s.hand.viscous, FINGERS, "not negative"),
    "dry": Quantity(lambda s: s.hand.dry, FINGERS, "not negative"),
    "gravity": Quantity(lambda s: s.gravity, ("x", "y")),
    "start": Quantity(lambda s: s.start, COORDINATES),
}

GEOMETRY = frozenset({"vertices", "center_of_mass", "joint", "length", "offset", "back", "range", "start"})
"""Quantities on which contact paths depend."""


class Spread(NamedTuple):
    """Half width of a uniform draw: a fraction of the value where `relative`, otherwise in the value's SI unit."""

    size: float
    relative: bool


def parameter_names(scene: Scene, quantity: str) -> tuple[str, ...]:
    """Name every number of a quantity, padding rows of the vertices included."""
    entries = QUANTITIES[quantity].entries
    if quantity == "vertices":
        entries = tuple(f"{k} {c}" for k in range(scene.object.vertices.shape[0]) for c in "xy")
    return (quantity,) if entries is None else tuple(f"{quantity} {entry}" for entry in entries)


def parse_spread(scene: Scene, name: str, amount: float | str) -> Spread:
    """Read an amount such as `0.0005` (SI unit) or `"20%"` for a quantity.

    Raises ValueError for a quantity that the scene does not have, for an amount that cannot be read, and for one with
    which a drawn scene may be invalid.
    """
    if name not in QUANTITIES:
        raise ValueError(f"{name}: not a quantity that varies; these do: {', '.join(QUANTITIES)}")
    if QUANTITIES[name].where(scene) is None:
        raise ValueError(f"{name}: the scene does not give it")
    text = str(amount)
    try:
        size = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        size = math.nan
    if not 0 <= size < math.inf:
        raise ValueError(f"{name}={text}: write an amount such as 0.0005, in SI units, or 20%")
    spread = Spread(size, text.endswith("%"))
    problem = _find_problem(scene, name, spread)
    if problem is not None:
        percent = "" if spread.relative or size < 1 else f"; a percentage is written {text}%"
        raise ValueError(f"{name}={text}: too much, {problem}{percent}")
    return spread


def _find_problem(scene: Scene, name: str, spread: Spread) -> str | None:
    """Say why a scene drawn with this spread may be invalid, or None."""
    value, allowed = np.asarray(QUANTITIES[name].where(scene)), QUANTITIES[name].allowed
    width = spread.size * (np.abs(value) if spread.relative else np.ones_like(value))
    smallest = np.min(value - width)
    if allowed != "any" and (smallest < 0 or (allowed == "positive" and smallest == 0)):
        return "it could become negative" if allowed == "not negative" else "it could become negative or 0"
    if name == "joint" and value[0, 0] - width[0, 0] <= value[1, 0] + width[1, 0]:
        return "the fingers could change sides"
    if name == "vertices":
        count = int(scene.object.count)
        if not remains_simple(value[:count], np.hypot(*width[:count].T)):
            return "edges of the polygon could cross"
    return None
