"""Outlines as tables of points: a row `x,y` a vertex, a blank line between outlines."""

import re
from pathlib import Path

import numpy as np

from wholearm_jax.core import SceneError
from wholearm_jax.files.drawn_curves import DrawnCurves

_UNIT = re.compile(r"[\[(/]\s*(\w+)")


def read_outline_points(path: Path, unit: str | None, tolerance: float, units: dict[str, float]) -> DrawnCurves:
    """Read outlines from a table: `x` and `y` in two columns, closed whether or not the first row stands again last.

    Separators may be commas, semicolons (with decimal commas then), tabs or spaces; a header may give the unit, as in
    `x [mm],y [mm]`; lines that begin with `#` are comments.

    Args:
        path: the file.
        unit: of its lengths; None: the header's.
        tolerance: not used: the points are the vertices.
        units: the units that are known, in metres.

    Raises:
        SceneError: naming the line that cannot be read, or that the unit is missing.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    outlines: list[list[list[float]]] = [[]]
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if text.startswith("#"):
            continue
        if not text.strip(",;"):
            outlines.append([])
            continue
        cells = _cells(text)
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            if any(outlines):
                raise SceneError(f"{path}: line {number}: {text!r:.40} is not two numbers") from None
            found = _UNIT.search(text)
            unit = unit or (found[1] if found else None)
            continue
        if len(row) != 2 or not np.isfinite(row).all():
            raise SceneError(f"{path}: line {number}: {text!r:.40} is not two finite numbers x,y")
        outlines[-1].append(row)
    if unit not in units:
        wrong = f"unit '{unit}' is not known" if unit else "its unit is not given"
        raise SceneError(f"{path}: {wrong}; write a header such as x [mm],y [mm], or give --unit mm")
    return DrawnCurves([units[unit] * np.array([*rows, rows[0]]) for rows in outlines if rows])


def _cells(text: str) -> list[str]:
    """Split a row at its separators."""
    if ";" in text:
        return [cell.strip().replace(",", ".") for cell in text.strip("; ").split(";")]
    return [cell for cell in re.split(r"[,\t ]+", text.strip(", ")) if cell]
