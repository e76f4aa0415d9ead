"""Polygons to put in a scene, all in one NumPy file.

`vertices` (`n`, `k`, 2) [m], rows beyond a polygon's `count` (`n`) ignored; `count` may be left out where all have `k`
vertices; `mass` (`n`) [kg] and `friction` (`n` or `n`, 3) may be vertices, otherwise they are the scene's. Density is
uniform.
"""

from pathlib import Path
from zipfile import BadZipFile
from zlib import error as ZlibError

import equinox as eqx
import jax
import numpy as np

from wholearm_jax.core import SceneError
from wholearm_jax.ensembles import SceneBatch
from wholearm_jax.model import Scene, find_defect

_UNREADABLE = (OSError, ValueError, KeyError, AttributeError, TypeError, EOFError, BadZipFile, ZlibError)


def count_polygons(path: Path) -> int:
    """Return the number of polygons of a file; 0 for a file that `read_polygons` will refuse."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return len(file["vertices"])
    except _UNREADABLE:
        return 0


def read_polygons(path: Path, scene: Scene) -> SceneBatch:
    """Return the scene with each polygon of a file.

    Raises:
        SceneError: Naming the file, the entry and what is wrong.
    """
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            entries = {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file") from None
    except _UNREADABLE as error:
        reason = f": {error.strerror}" if isinstance(error, OSError) and error.strerror else ""
        raise SceneError(f"{path}: not a NumPy .npz file of numbers{reason}") from None
    for name, values in entries.items():
        if values.dtype.kind not in "fiu":
            raise SceneError(f"{path}: {name}: needs real numbers, not {values.dtype}")
    vertices = entries.get("vertices")
    if vertices is None or vertices.ndim != 3 or vertices.shape[2] != 2 or vertices.shape[1] < 3 or not len(vertices):
        raise SceneError(f"{path}: vertices: needs an array (polygons, vertices, 2) of at least 3 vertices")
    total, width = vertices.shape[:2]
    count = entries.get("count", np.full(total, width))
    if count.shape != (total,) or count.dtype.kind not in "iu" or count.min() < 3 or count.max() > width:
        raise SceneError(f"{path}: count: needs one whole number of 3 to {width} a polygon")
    _require_polygons(path, vertices, count)
    rows = np.minimum(np.arange(width + (-width % 8)), count[:, None] - 1)  # rows that pad repeat the last vertex
    vertices = np.take_along_axis(np.asarray(vertices, float), rows[:, :, None], axis=1)
    mass = _read_positive(path, "mass", entries, (total,), np.asarray(scene.object.mass), strictly=True)
    coefficients = entries.get("friction", np.asarray(scene.object.friction)[None])
    coefficients = coefficients[:, None] if coefficients.ndim == 1 else coefficients
    friction = _read_positive(path, "friction", {"friction": coefficients}, (total, 3), None, strictly=False)
    _require_named_features(path, scene, count)
    repeated = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (total, *np.shape(leaf))), scene)
    return SceneBatch(eqx.tree_at(_shape, repeated, (vertices, count, mass, friction)))


def _shape(scene: Scene) -> tuple:
    return scene.object.vertices, scene.object.count, scene.object.mass, scene.object.friction


def _require_polygons(path, vertices, count) -> None:
    """Refuse vertices that make no polygon."""
    for size in np.unique(count):
        numbers = np.flatnonzero(count == size)
        chosen = vertices[numbers, :size]
        finite = np.isfinite(chosen).all((1, 2))
        if not finite.all():
            raise SceneError(f"{path}: vertices[{numbers[np.argmin(finite)]}]: not finite")
        defect = find_defect(np.asarray(chosen, float))
        if defect is not None:
            raise SceneError(f"{path}: vertices[{numbers[defect[0]]}]: {defect[1]}")


def _read_positive(path, name: str, entries, shape, otherwise, *, strictly: bool):
    value = np.asarray(entries.get(name, otherwise), float)
    try:
        value = np.broadcast_to(value, shape)
    except ValueError:
        raise SceneError(f"{path}: {name}: needs one number a polygon") from None
    if not np.all(np.isfinite(value)) or np.any(value < 0) or (strictly and np.any(value == 0)):
        raise SceneError(f"{path}: {name}: needs positive numbers")
    return value


def _require_named_features(path, scene: Scene, count) -> None:
    """Refuse polygons without the vertices and edges that the formations name."""
    highest = max(int(np.max(np.asarray(p.formation.feature))) for p in scene.phases)
    if count.min() <= highest:
        row = int(np.argmax(count <= highest))
        raise SceneError(f"{path}: count[{row}]: the scene's contacts name feature {highest}, which it does not have")
