"""Polygons to put in a scene, many in one NumPy file.

`vertices` (`n`, `k`, 2) [m], rows beyond a polygon's `count` (`n`) ignored; `count` may be left out where all have `k`
vertices; `mass` (`n`) [kg] and `friction` (`n` or `n`, 3) may be given, otherwise they are the scene's. Density is
uniform.
"""

from pathlib import Path
from zipfile import BadZipFile
from zlib import error as ZlibError

import jax
import numpy as np

from wholearm_jax.core import SceneError
from wholearm_jax.ensembles import SceneBatch
from wholearm_jax.model import Polygon, Scene, find_defect

_UNREADABLE = (OSError, ValueError, KeyError, AttributeError, TypeError, EOFError, BadZipFile, ZlibError)


def count_polygons(path: Path) -> int:
    """How many polygons a file has; 0 where it is none, of which `read_polygons` tells more."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return len(file["vertices"])
    except _UNREADABLE:
        return 0


def read_polygons(path: Path, scene: Scene) -> SceneBatch:
    """The scene with each polygon of a file. Raises `SceneError` naming the file, the entry and what is wrong."""
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            held = {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file") from None
    except _UNREADABLE as error:
        raise SceneError(f"{path}: not a NumPy .npz file: {error}") from None
    for name, values in held.items():
        if values.dtype.kind not in "fiu":
            raise SceneError(f"{path}: {name}: needs real numbers, not {values.dtype}")
    given = held.get("vertices")
    if given is None or given.ndim != 3 or given.shape[2] != 2 or given.shape[1] < 3 or not len(given):
        raise SceneError(f"{path}: vertices: needs an array (polygons, vertices, 2) of at least 3 vertices")
    many, width = given.shape[:2]
    count = held.get("count", np.full(many, width))
    if count.shape != (many,) or count.dtype.kind not in "iu" or count.min() < 3 or count.max() > width:
        raise SceneError(f"{path}: count: needs one whole number of 3 to {width} a polygon")
    _outlines(path, given, count)
    rows = np.minimum(np.arange(width + (-width % 8)), count[:, None] - 1)  # rows that pad repeat the last vertex
    vertices = np.take_along_axis(np.asarray(given, float), rows[:, :, None], axis=1)
    mass = _positive(path, "mass", held, (many,), np.asarray(scene.object.mass), strictly=True)
    rubs = held.get("friction", np.asarray(scene.object.friction)[None])
    rubs = rubs[:, None] if rubs.ndim == 1 else rubs
    friction = _positive(path, "friction", {"friction": rubs}, (many, 3), None, strictly=False)
    _named_vertices(path, scene, count)
    shape = Polygon(vertices=vertices, count=count, mass=mass, friction=friction)  # pyright: ignore
    alike = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (many, *np.shape(leaf))), scene)
    return SceneBatch(Scene(scene.title, alike.gravity, alike.hand, shape, alike.start, alike.phases))


def _outlines(path, vertices, count) -> None:
    """Every row of vertices must be a polygon."""
    for size in np.unique(count):
        which = np.flatnonzero(count == size)
        chosen = vertices[which, :size]
        finite = np.isfinite(chosen).all((1, 2))
        if not finite.all():
            raise SceneError(f"{path}: vertices[{which[np.argmin(finite)]}]: not finite")
        flaw = find_defect(np.asarray(chosen, float))
        if flaw is not None:
            raise SceneError(f"{path}: vertices[{which[flaw[0]]}]: {flaw[1]}")


def _positive(path, name: str, held, shape, otherwise, *, strictly: bool):
    value = np.asarray(held.get(name, otherwise), float)
    try:
        value = np.broadcast_to(value, shape)
    except ValueError:
        raise SceneError(f"{path}: {name}: needs one number a polygon") from None
    if not np.all(np.isfinite(value)) or np.any(value < 0) or (strictly and np.any(value == 0)):
        raise SceneError(f"{path}: {name}: needs positive numbers")
    return value


def _named_vertices(path, scene: Scene, count) -> None:
    """Every polygon must have the vertices and edges that the formations name."""
    highest = max(int(np.max(np.asarray(p.formation.feature))) for p in scene.phases)
    if count.min() <= highest:
        row = int(np.argmax(count <= highest))
        raise SceneError(f"{path}: count[{row}]: the scene's contacts name feature {highest}, which it does not have")
