"""Angles in scenes: numbers of radians, or texts with a unit such as "-40 deg"."""

import math
import re
from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from wholearm_jax.model import ANGLE_COORDINATES

ANGLE_HINT = "a number of radians or a text such as '-40 deg'"
_UNITS = {"deg": math.pi / 180, "°": math.pi / 180, "degree": math.pi / 180, "degrees": math.pi / 180, "rad": 1.0}
_TEXT = re.compile(r"\s*(?P<number>[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)\s*(?P<unit>[a-z°]+)\s*")


def read_angle(value: Any) -> Any:
    """Return the radians of a text such as `"-40 deg"`; anything but a text stays as it is.

    Raises:
        ValueError: For a text that is no angle.
    """
    if not isinstance(value, str):
        return value
    match = _TEXT.fullmatch(value)
    factor = _UNITS.get(match["unit"]) if match else None
    if match is None or factor is None:
        raise ValueError(f"must be {ANGLE_HINT}, not {value!r:.40}")
    number = float(match["number"])
    angle = math.radians(number) if factor != 1.0 else number
    if not math.isfinite(angle):
        raise ValueError(f"must be finite, not {value!r:.40}")
    return angle


def read_angles_by_coordinate(values: Any) -> Any:
    """Return a table of coordinates with `read_angle` applied to those that are angles."""
    if not isinstance(values, dict):
        return values
    read = {}
    for key, value in values.items():
        try:
            read[key] = read_angle(value) if key in ANGLE_COORDINATES else value
        except ValueError as error:
            raise ValueError(f"{key}: {error}") from None
    return read


Angle = Annotated[float, Field(strict=True, allow_inf_nan=False), BeforeValidator(read_angle)]
"""An angle of a scene file: radians, or a text with a unit."""


def is_beyond_a_turn(angle: float) -> bool:
    """Say whether an angle [rad] is more than a whole turn, as degrees often are."""
    return bool(abs(angle) > 2 * math.pi)


def doubtful_angles(data: dict[str, Any]) -> Iterator[str]:
    """Yield a note for every angle of a valid scene that is a number beyond a whole turn, as degrees often are."""
    start, hand = data["start"], data["hand"]
    places = [(f"start.{name}", start.get(name)) for name in ANGLE_COORDINATES]
    for finger in ("finger1", "finger2"):
        places += [(f"hand.{finger}.range[{k}]", angle) for k, angle in enumerate(hand[finger].get("range", ()))]
    for k, phase in enumerate(data.get("phase", ())):
        places += [(f"phase[{k}].until.{name}", angle) for name, angle in (phase.get("until") or {}).items()]
    for place, angle in places:
        is_angle = place.rpartition(".")[2] not in ("x", "y")
        if is_angle and isinstance(angle, int | float) and is_beyond_a_turn(angle):
            yield f'{place}: {angle:g} radians are more than a whole turn; degrees are written "{angle:g} deg"'
