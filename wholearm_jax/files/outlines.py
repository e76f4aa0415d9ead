"""Outlines from drawings: polygons in metres, with what their holes take from mass and inertia."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.polygon import orient

from wholearm_jax.core import SceneError
from wholearm_jax.files.drawn_curves import DrawnCurves, close_chains, name_place
from wholearm_jax.model import find_defect

UNITS = {
    "m": 1.0,
    "dm": 0.1,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "in": 0.0254,
    "ft": 0.3048,
    "mil": 2.54e-5,
    "uin": 2.54e-8,
    "px": 0.0254 / 96,
    "pt": 0.0254 / 72,
}
"""Units of drawings [m]."""
READERS = {
    ".dxf": ("dxf_curves", "read_dxf_curves"),
    ".svg": ("svg_curves", "read_svg_curves"),
    ".csv": ("outline_csv", "read_outline_points"),
    ".txt": ("outline_csv", "read_outline_points"),
    ".stl": ("stl_section", "read_stl_section"),
}
"""By a file's ending: a module of this folder, and its function."""
DEFAULT_TOLERANCE_MM = 0.05
_ROUNDING = 50  # vertices are rounded to this part of the tolerance, or finer


@dataclass(frozen=True)
class Outline:
    """An outline of a drawing, and the holes within it.

    `vertices` (n, 2) [m], anticlockwise, in the drawing's frame; `holes`, each (k, 2) [m]. `area` [m^2], `centroid`
    [m] and `second_moment` [m^4] about the centroid are those of the outline without its holes' areas.
    """

    source: str
    vertices: Float[np.ndarray, "vertices 2"]
    holes: tuple[Float[np.ndarray, "_ 2"], ...]
    area: float
    centroid: tuple[float, float]
    second_moment: float
    skipped: tuple[str, ...] = ()  # what of the drawing was passed over

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the bounding box [m]."""
        width, height = np.ptp(self.vertices, axis=0).tolist()
        return width, height

    @property
    def title(self) -> str:
        """The file's name without its folder and ending."""
        return Path(self.source).stem


def read_outlines(
    path: str | Path, *, unit: str | None = None, tolerance: float = DEFAULT_TOLERANCE_MM * 1e-3
) -> tuple[Outline, ...]:
    """Read all outlines of a drawing, the largest first.

    Args:
        path: a DXF, SVG or STL file, or a CSV file of points.
        unit: of its lengths, such as `"mm"`; None: the file's own.
        tolerance: how far vertices and edges may be from the drawing [m].

    Raises:
        SceneError: with one line that names the file and what is wrong with it.
    """
    source = Path(path)
    if unit is not None and unit not in UNITS:
        raise SceneError(f"{path}: unit '{unit}' is not known; these are: {', '.join(UNITS)}")
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise SceneError(f"{path}: the tolerance must be a positive length, not {tolerance:g}")
    if source.suffix.lower() not in READERS:
        raise SceneError(f"{path}: a drawing is a file that ends in {', '.join(READERS)}")
    if not source.is_file():
        raise SceneError(f"{path}: no such file")
    # Curves take half of the tolerance, the removal of vertices the other half.
    drawn = _reader(source)(source, unit, tolerance / 2, UNITS)
    if not drawn.chains:
        passed = f"; passed over: {', '.join(drawn.skipped)}" if drawn.skipped else ""
        raise SceneError(f"{path}: no curves in it{passed}")
    shown = UNITS[unit] if unit else UNITS["mm"]
    rings = close_chains(str(path), drawn.chains, tolerance, shown)
    polygons = [_ring_polygon(str(path), ring, tolerance, shown) for ring in rings]
    nested = _nest(str(path), _unlike(polygons, tolerance), tolerance)
    return tuple(_outline(str(path), outer, holes, tolerance, drawn.skipped) for outer, holes in nested)


def read_outline(
    path: str | Path,
    *,
    unit: str | None = None,
    tolerance: float = DEFAULT_TOLERANCE_MM * 1e-3,
    number: int | None = None,
    fill_holes: bool = False,
) -> Outline:
    """Read one outline of a drawing.

    Args:
        path: a DXF, SVG or STL file, or a CSV file of points.
        unit: of its lengths, such as `"mm"`; None: the file's own.
        tolerance: how far vertices and edges may be from the drawing [m].
        number: which outline, from 1, the largest first; needed where there are several.
        fill_holes: whether holes are accepted: nothing can touch them, but they count in mass and inertia.

    Raises:
        SceneError: with one line that names the file and what is wrong with it.

    >>> text = "x [mm],y [mm]\\n0,0\\n60,0\\n60,40\\n0,40\\n"
    >>> _ = (folder / "box.csv").write_text(text)
    >>> wa.read_outline(folder / "box.csv").vertices.tolist()
    [[0.0, 0.0], [0.06, 0.0], [0.06, 0.04], [0.0, 0.04]]
    """
    return choose_outline(read_outlines(path, unit=unit, tolerance=tolerance), number, fill_holes=fill_holes)


def choose_outline(outlines: tuple[Outline, ...], number: int | None, *, fill_holes: bool = False) -> Outline:
    """Choose an outline by its number, from 1. Raises `SceneError` where that is missing, wrong, or has holes."""
    source = outlines[0].source
    if number is None and len(outlines) > 1:
        listed = "; ".join(f"{k}: {describe_outline(one)}" for k, one in enumerate(outlines[:4], 1))
        raise SceneError(f"{source}: {len(outlines)} outlines ({listed}); choose one by its number")
    if not 1 <= (number or 1) <= len(outlines):
        raise SceneError(f"{source}: outline {number}: there are outlines 1 to {len(outlines)}")
    chosen = outlines[(number or 1) - 1]
    if chosen.holes and not fill_holes:
        count, them = len(chosen.holes), "them" if len(chosen.holes) > 1 else "it"
        raise SceneError(f"{source}: the outline has {count} hole{'s' * (count > 1)}; --fill-holes accepts {them}")
    return chosen


def describe_outline(outline: Outline) -> str:
    """Say how large an outline is."""
    width, height = (1e3 * length for length in outline.size)
    return f"{1e6 * outline.area:.4g} mm^2, {width:.4g} x {height:.4g} mm"


def _reader(path: Path) -> Callable[[Path, str | None, float, dict[str, float]], DrawnCurves]:
    """Import the reader of a kind of file; its library may be missing."""
    module, name = READERS[path.suffix.lower()]
    try:
        return getattr(import_module(f"wholearm_jax.files.{module}"), name)
    except ModuleNotFoundError as error:
        raise SceneError(f"{path}: reading it needs {error.name}: pip install 'wholearm_jax[cad]'") from None


def _ring_polygon(source: str, ring: np.ndarray, tolerance: float, unit: float) -> shapely.Polygon:
    """Make a polygon of a closed ring, without the vertices that the tolerance can do without."""
    corner = int(np.lexsort(ring[:-1].T)[0])  # lowest, then leftmost: begins and ends are never removed
    ring = np.concatenate([ring[corner:-1], ring[: corner + 1]])
    if shapely.MultiPoint(ring).convex_hull.area <= tolerance * np.ptp(ring, axis=0).max():
        raise SceneError(f"{source}: the contour at {name_place(ring[0], unit)} has no area")
    if not shapely.LinearRing(ring).is_valid:
        raise SceneError(f"{source}: the contour at {name_place(_crossing(ring), unit)} crosses or touches itself")
    simplified = shapely.Polygon(ring).simplify(tolerance / 2, preserve_topology=True)
    return shapely.Polygon(simplified.exterior)  # pyright: ignore[reportAttributeAccessIssue]


def _crossing(ring: np.ndarray) -> np.ndarray:
    """Return a place at which a ring meets itself."""
    words = shapely.is_valid_reason(shapely.Polygon(ring))
    numbers = words.partition("[")[2].rstrip("]").split()
    return np.array([float(number) for number in numbers]) if len(numbers) == 2 else ring[0]


def _unlike(polygons: list[shapely.Polygon], tolerance: float) -> list[shapely.Polygon]:
    """Drop polygons that repeat another one within the tolerance; the largest first."""
    kept: list[shapely.Polygon] = []
    for one in sorted(polygons, key=lambda p: -p.area):
        if not any(shapely.hausdorff_distance(one.exterior, other.exterior) <= tolerance for other in kept):
            kept.append(one)
    return kept


def _nest(source: str, polygons: list[shapely.Polygon], tolerance: float):
    """Yield each outer polygon with those that lie directly within it, its holes."""
    tree = shapely.STRtree(polygons)
    depth, parent = [0] * len(polygons), [-1] * len(polygons)
    for k, one in enumerate(polygons):  # the largest first: what contains others comes before them
        for other in sorted(tree.query(one, predicate="intersects").tolist()):
            if other >= k:
                continue
            outside, inside = one.difference(polygons[other]).area, one.intersection(polygons[other]).area
            slight = tolerance * one.length
            if outside > slight and inside > slight:
                where = name_place(np.array(one.exterior.coords[0]), UNITS["mm"])
                raise SceneError(f"{source}: two contours cross; one of them begins at {where} mm")
            if outside <= slight:
                depth[k], parent[k] = depth[k] + 1, other
    for k, one in enumerate(polygons):
        if depth[k] % 2 == 0:
            yield one, [p for p, up, deep in zip(polygons, parent, depth, strict=True) if up == k and deep % 2]


def _outline(source: str, outer: shapely.Polygon, holes, tolerance: float, skipped: tuple[str, ...]) -> Outline:
    """Round an outline's vertices, and take its holes from its area."""
    decimals = int(np.ceil(-np.log10(tolerance / _ROUNDING)))
    rings = [np.round(np.array(orient(p).exterior.coords)[:-1], decimals) + 0.0 for p in (outer, *holes)]
    defect = find_defect(rings[0][None])
    if defect is not None:
        raise SceneError(f"{source}: {defect[1]}; a smaller tolerance may help")
    origin = rings[0].mean(0)  # sums about a nearby point keep their decimals
    area, first, second = np.zeros(()), np.zeros(2), np.zeros(())
    for more in _signed_moments([ring - origin for ring in rings]):
        area, first, second = area + more[0], first + more[1], second + more[2]
    centroid = first / area
    return Outline(
        source,
        rings[0],
        tuple(rings[1:]),
        float(area),
        (float(origin[0] + centroid[0]), float(origin[1] + centroid[1])),
        float(second - area * centroid @ centroid),
        skipped,
    )


def _signed_moments(rings: list[np.ndarray]):
    """Yield area, first and polar second moment about the origin of rings, negative for all but the first."""
    for k, here in enumerate(rings):
        there, sign = np.roll(here, -1, axis=0), 1.0 if k == 0 else -1.0
        cross = here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]
        first = (cross[:, None] * (here + there)).sum(0) / 6
        second = (cross[:, None] * (here**2 + here * there + there**2)).sum() / 12
        yield sign * cross.sum() / 2, sign * first, sign * second
