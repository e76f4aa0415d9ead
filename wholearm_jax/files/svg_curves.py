"""Curves of SVG drawings: paths and basic shapes with their transforms, in groups and `use` or not."""

import io
import math
import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import svgelements

from wholearm_jax.core import SceneError
from wholearm_jax.files.drawn_curves import DrawnCurves

PIXELS_PER_INCH = 96.0
_LENGTH = re.compile(r"\s*[+]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*(mm|cm|in|pt|pc|px|Q)?\s*")


def read_svg_curves(path: Path, unit: str | None, tolerance: float, units: dict[str, float]) -> DrawnCurves:
    """Read the curves of an SVG file; `y` points up in what is returned.

    Args:
        path: the file.
        unit: of its user units; None: as its width, height and view box say, else CSS pixels.
        tolerance: how far chords may be from curves [m].
        units: the units that are known, in metres.

    Raises:
        SceneError: for a file that cannot be read.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise SceneError(f"{path}: not an SVG file that can be read: {error}") from None
    if root.tag.rpartition("}")[2] != "svg":
        raise SceneError(f"{path}: not an SVG file: its outermost element is <{root.tag.rpartition('}')[2]}>")
    sized = all(_LENGTH.fullmatch(root.get(key, "")) for key in ("width", "height"))
    if unit is not None or not sized:  # coordinates are taken as they stand
        for key in ("width", "height", "viewBox"):
            root.attrib.pop(key, None)
    scale = units[unit] if unit else units["in"] / PIXELS_PER_INCH
    try:
        parsed: Any = svgelements.SVG.parse(io.BytesIO(ElementTree.tostring(root)), reify=True, ppi=PIXELS_PER_INCH)
        shapes = [element for element in parsed.elements() if isinstance(element, svgelements.Shape)]
        curves = [abs(svgelements.Path(shape)) for shape in shapes]
    except (ValueError, TypeError, AttributeError, IndexError, ZeroDivisionError) as error:
        raise SceneError(f"{path}: a path cannot be read: {error}") from None
    chains = [scale * chain * [1.0, -1.0] for curve in curves for chain in _chains(curve, tolerance / scale)]
    kinds = Counter(type(element).__name__ for element in parsed.elements())
    skipped = tuple(f"{kinds[kind]} {kind}" for kind in ("Text", "Image") if kinds[kind])
    return DrawnCurves(chains, skipped)


def _chains(curve: Any, tolerance: float) -> list[np.ndarray]:
    """Flatten each part of a path into points of its own."""
    chains: list[list[tuple[float, float]]] = []
    for segment in curve:
        kind = type(segment).__name__
        if kind == "Move":
            chains.append([(segment.end.x, segment.end.y)])
        elif segment.end is not None and chains:
            if kind == "Close":
                chains[-1].append(chains[-1][0])
                chains.append([chains[-1][0]])  # what follows without a move begins where the closed part did
            else:
                count = _chords(segment, tolerance)
                points = [segment.point((k + 1) / count) for k in range(count - 1)]
                chains[-1] += [(p.x, p.y) for p in (*points, segment.end)]
    return [np.array(chain) for chain in chains if len(chain) > 1]


def _chords(segment: Any, tolerance: float) -> int:
    """Return how many chords, evenly spaced in the parameter, keep within a tolerance of a segment."""
    kind = type(segment).__name__
    if kind == "Arc":
        radius = max(abs(segment.rx), abs(segment.ry))
        step = 2 * math.acos(max(1 - tolerance / radius, 0.0)) if radius > 0 else math.pi
        return max(math.ceil(abs(float(segment.sweep)) / step), 1)
    curves = {"QuadraticBezier": ("start", "control", "end"), "CubicBezier": ("start", "control1", "control2", "end")}
    keys = curves.get(kind)
    if keys is None:
        return 1
    controls = np.array([(getattr(segment, key).x, getattr(segment, key).y) for key in keys])
    # A chord is off by at most |P''| h^2 / 8, and |P''| at most n (n - 1) times the controls' second differences.
    degree, bend = len(keys) - 1, np.hypot(*np.diff(controls, 2, axis=0).T).max()
    return max(math.ceil(math.sqrt(degree * (degree - 1) * bend / (8 * tolerance))), 1)
