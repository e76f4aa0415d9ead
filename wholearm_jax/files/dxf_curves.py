"""Curves of DXF drawings: lines, arcs, circles, ellipses, polylines with bulges and splines, in blocks or not."""

from collections import Counter
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
from ezdxf import path as ezpath
from scipy.interpolate import BSpline

from wholearm_jax.core import SceneError
from wholearm_jax.files.drawn_curves import DrawnCurves

DXF_UNITS = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 8: "uin", 9: "mil", 13: "um", 14: "dm"}
"""What `$INSUNITS` means."""
_CURVES = {"LINE", "ARC", "CIRCLE", "ELLIPSE", "LWPOLYLINE", "POLYLINE", "SPLINE", "HELIX", "SOLID", "TRACE"}


def read_dxf_curves(path: Path, unit: str | None, tolerance: float, units: dict[str, float]) -> DrawnCurves:
    """Read the curves of a DXF file's model space.

    Args:
        path: the file.
        unit: of its lengths; None: the file's own.
        tolerance: how far chords may be from curves [m].
        units: the units that are known, in metres.

    Raises:
        SceneError: for a file that cannot be read, or that does not give its unit.
    """
    try:
        document = ezdxf.readfile(path)  # pyright: ignore[reportPrivateImportUsage]
    except (OSError, UnicodeDecodeError, ezdxf.DXFError) as error:  # pyright: ignore[reportPrivateImportUsage]
        raise SceneError(f"{path}: not a DXF file that can be read: {error}") from None
    number = int(document.header.get("$INSUNITS", 0))
    name = unit or DXF_UNITS.get(number)
    if name not in units:
        raise SceneError(f"{path}: its unit is not given ($INSUNITS is {number}); say which, such as --unit mm")
    scale, skipped = units[name], Counter[str]()
    hidden = {layer.dxf.name.lower() for layer in document.layers if layer.is_off() or layer.is_frozen()}
    chains = []
    for entity in _entities(path, document.modelspace(), hidden, skipped):
        chains += [scale * points for points in _flatten(entity, tolerance / scale)]
    return DrawnCurves(chains, tuple(f"{count} {kind}" for kind, count in sorted(skipped.items())))


def _entities(path: Path, entities: Any, hidden: set[str], skipped: Counter[str]):
    """Yield the curves among entities, those of inserted blocks where they are inserted; count what is passed over."""
    for entity in entities:
        kind = entity.dxftype()
        if entity.dxf.get("layer", "0").lower() in hidden or entity.dxf.get("invisible", 0):
            skipped[f"{kind} on hidden layers"] += 1
        elif kind == "INSERT":
            if entity.block() is None:
                raise SceneError(f"{path}: block '{entity.dxf.name}' is inserted, but not in the file")
            for one in entity.multi_insert() if entity.mcount > 1 else [entity]:
                yield from _entities(path, one.virtual_entities(), hidden, skipped)
        elif kind in _CURVES and not (kind == "POLYLINE" and not (entity.is_2d_polyline or entity.is_3d_polyline)):
            yield entity
        else:
            skipped[kind] += 1


def _flatten(entity: Any, tolerance: float) -> list[np.ndarray]:
    """Return the chains of points of an entity, chords within a tolerance of it; lengths in the drawing's unit."""
    if entity.dxftype() == "SPLINE":
        tool = entity.construction_tool()
        knots, degree = np.array(tool.knots()), tool.degree
        if knots[0] < knots[degree] or knots[-1] > knots[-degree - 1]:
            weights = np.array(tool.weights() or np.ones(tool.count))[:, None]
            controls = np.array([(point.x, point.y) for point in tool.control_points])
            return [_flatten_unclamped(BSpline(knots, np.hstack([controls * weights, weights]), degree), tolerance)]
    curve = ezpath.make_path(entity)
    pieces = curve.sub_paths() if curve.has_sub_paths else [curve]
    chains = [np.array([(point.x, point.y) for point in piece.flattening(tolerance)]) for piece in pieces]
    return [chain for chain in chains if len(chain)]


def _flatten_unclamped(spline: BSpline, tolerance: float) -> np.ndarray:
    """Flatten a rational spline whose knots reach beyond its ends, as those of periodic splines do."""
    inner = np.unique(spline.t[spline.k : -spline.k])
    count = 4  # chords a span, doubled until the places between them are near
    while True:
        steps = np.diff(inner)[:, None] * np.arange(2 * count) / (2 * count)
        homogeneous = spline(np.append((inner[:-1, None] + steps).ravel(), inner[-1]))
        points = homogeneous[:, :2] / homogeneous[:, 2:]
        off = np.hypot(*(points[1::2] - (points[:-1:2] + points[2::2]) / 2).T)
        if off.max() <= tolerance / 2 or count >= 4096:
            return points[::2]
        count *= 2
