"""The flat section of an STL body: halfway up, across the z axis."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from wholearm_jax.core import DoubtfulInput, SceneError
from wholearm_jax.files.drawn_curves import DrawnCurves

HEIGHTS = (0.25, 0.5, 0.75)  # of the sections that must agree, over the body's height
PRISM_TOL = 0.01  # relative difference of their lengths


def read_stl_section(path: Path, unit: str | None, tolerance: float, units: dict[str, float]) -> DrawnCurves:
    """Cut a body halfway up across its z axis; a `DoubtfulInput` warning says if it is no prism along z.

    Args:
        path: the file.
        unit: of its lengths, which an STL file does not say.
        tolerance: not used: the body is flat between its vertices.
        units: the units that are known, in metres.

    Raises:
        SceneError: for a file that cannot be read, or without a unit.
    """
    if unit is None:
        raise SceneError(f"{path}: an STL file does not say its unit; give it, such as --unit mm")
    try:
        body: Any = trimesh.load(path, file_type="stl", force="mesh")
        low, high = np.asarray(body.bounds)[:, 2]
    except Exception as error:  # whatever a damaged file leads to
        raise SceneError(f"{path}: not an STL file that can be read: {error or type(error).__name__}") from None
    if not high > low:
        raise SceneError(f"{path}: the body is flat across z: it has no section")
    sections = [_cut(body, low + fraction * (high - low)) for fraction in HEIGHTS]
    lengths = [np.hypot(*(s[:, 1] - s[:, 0]).T).sum() for s in sections]
    if np.ptp(lengths) > PRISM_TOL * max(lengths):
        warnings.warn(f"{path}: not a prism along z; its section at half its height is used", DoubtfulInput, 2)
    return DrawnCurves([units[unit] * segment for segment in sections[1]])


def _cut(body: Any, height: float) -> np.ndarray:
    """Return the segments `(n, 2, 2)` in which a plane across z cuts a body."""
    lines = trimesh.intersections.mesh_plane(body, [0.0, 0.0, 1.0], [0.0, 0.0, height])
    return np.asarray(lines, float).reshape(-1, 2, 3)[:, :, :2]
