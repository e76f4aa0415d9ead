"""Scenes from outlines: the tables of a scene file, with a hand and a start that fit the part."""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import tomli_w

from wholearm_jax.core import SceneError
from wholearm_jax.files.outlines import Outline
from wholearm_jax.files.scene_schema import FingerTable
from wholearm_jax.files.scene_toml import parse_start
from wholearm_jax.model import LINKS, HandChoice, Scene, choose_hand, polygon

DEFAULT_DENSITY = 40.0  # [kg/m^2]: 15 mm of aluminium
DEFAULT_FRICTION = 0.1
MASSES = ("mass", "density")
_ROW = re.compile(r"\[\s+([^\[\]]*?),\s+\]")


def scene_from_outline(
    outline: Outline,
    *,
    mass: float | None = None,
    density: float | None = None,
    friction: float | Mapping[str, float] = DEFAULT_FRICTION,
    on: str | None = None,
    title: str | None = None,
) -> Scene:
    """Make a scene without phases of an outline: a hand to start from, and the part at rest between its fingers.

    Args:
        outline: the part, as `read_outline` returns it.
        mass: [kg]; None: by density.
        density: mass over the outline's area without holes [kg/m^2]; None: that of 15 mm of aluminium.
        friction: Coulomb's coefficient of all contacts, or of each link's: `{"palm": 0.5, "finger1": 0.1, ...}`.
        on: the edge to begin on, `e0` from the outline's first vertex to its second; None: the steadiest.
        title: of the scene; None: the file's name.

    Returns:
        A scene that `plan` takes as it is.

    Raises:
        SceneError: where the part cannot rest on an edge between the fingers, or a number is not usable.

    >>> _ = (folder / "box.csv").write_text("x [mm],y [mm]\\n0,0\\n60,0\\n60,40\\n0,40\\n")
    >>> scene = wa.scene_from_outline(wa.read_outline(folder / "box.csv"), mass=0.1)
    >>> float(scene.object.mass), scene.phases
    (0.1, ())
    """
    tables, _ = outline_tables(outline, mass=mass, density=density, friction=friction, on=on, title=title)
    return parse_start(tables, outline.source)


def outline_tables(
    outline: Outline,
    *,
    mass: float | None = None,
    density: float | None = None,
    friction: float | Mapping[str, float] = DEFAULT_FRICTION,
    on: str | None = None,
    title: str | None = None,
) -> tuple[dict[str, Any], HandChoice]:
    """Return the tables of a scene file for an outline, and how its hand was chosen; arguments as of
    `scene_from_outline`."""
    if mass is not None and density is not None:
        raise SceneError(f"{outline.source}: give mass or density, not both")
    of_links = dict(friction) if isinstance(friction, Mapping) else dict.fromkeys(LINKS, friction)
    if of_links.keys() != {*LINKS}:
        raise SceneError(f"{outline.source}: friction: give one number, or one for each of {', '.join(LINKS)}")
    given = {"mass": mass, "density": density} | {f"friction of {link}": value for link, value in of_links.items()}
    for name, value in given.items():
        if value is not None and not (math.isfinite(value) and (value > 0 or (name not in MASSES and value == 0))):
            raise SceneError(f"{outline.source}: {name}: must be positive, not {value:g}")
    weight = mass if mass is not None else (density or DEFAULT_DENSITY) * outline.area
    weight = float(f"{weight:.6g}")
    one = len({*of_links.values()}) == 1
    table: dict[str, Any] = {
        "vertices": outline.vertices.tolist(),
        "mass": weight,
        "friction": of_links["palm"] if one else of_links,
    }
    if outline.holes:
        table["inertia"] = float(f"{weight * outline.second_moment / outline.area:.6g}")
        table["center_of_mass"] = np.round(outline.centroid, 9).tolist()
    shape = polygon(
        outline.vertices, weight, [of_links[link] for link in LINKS], table.get("inertia"), table.get("center_of_mass")
    )
    edge = None if on is None else _edge_number(outline, on)
    try:
        choice = choose_hand(shape, edge)
    except ValueError as error:
        raise SceneError(f"{outline.source}: {error}") from None
    rows = [
        {key: np.asarray(getattr(choice.hand, key))[k].tolist() for key in FingerTable.model_fields} for k in range(2)
    ]
    defaults = {"offset": 0.0, "back": 0.0, "range": [0.0, math.pi]}
    fingers = [{key: value for key, value in row.items() if value != defaults.get(key)} for row in rows]
    tables = {
        "title": title or outline.title,
        "gravity": 9.81,
        "hand": {"finger1": fingers[0], "finger2": fingers[1]},
        "object": table,
        "start": {"on": f"e{choice.edge}", "x": choice.x},
    }
    return tables, choice


def _edge_number(outline: Outline, name: str) -> int:
    """Read the name of an edge."""
    number, count = name.removeprefix("e"), len(outline.vertices)
    if not (number.isdecimal() and int(number) < count):
        raise SceneError(f"{outline.source}: {name}: the outline's edges are e0 to e{count - 1}")
    return int(number)


def scene_text(tables: Mapping[str, Any], comments: list[str]) -> str:
    """Write a scene's tables as TOML, below lines of comment; each row of numbers in a line."""
    text = _ROW.sub(lambda row: f"[{', '.join(row[1].split())}]".replace(",,", ","), tomli_w.dumps(tables))
    return "".join(f"# {line}\n" for line in comments) + "\n" + text


def describe_choice(choice: HandChoice) -> list[str]:
    """Say in lines how a hand and a start were chosen."""
    hand = choice.hand
    span, length = float(hand.joint[0, 0] - hand.joint[1, 0]), float(hand.length[0])
    width, height = choice.width, choice.height
    return [
        f"part at rest: {1e3 * width:.4g} mm wide, {1e3 * height:.4g} mm high, on edge {choice.edge}, from which it "
        f"tips at {math.degrees(choice.tipping_angle):.3g} degrees",
        f"hand: joints {1e3 * span:.4g} mm apart, {span / width:.3g} times its width; fingers {1e3 * length:.4g} mm "
        f"long, {length / (width + height):.3g} times its width and height together: both close on it",
    ]
