"""TOML scenes, CSV and JSON results, NPZ polygons, and the Zarr store of checks."""

from wholearm_jax.files.polygons_npz import count_polygons, read_polygons
from wholearm_jax.files.results import (
    TRAJECTORY_COLUMNS,
    discard,
    discard_execution,
    execution_summary,
    read_torque,
    summary,
    write_execution,
    write_summary,
    write_torque,
    write_trajectory,
)
from wholearm_jax.files.scene_toml import Positive, bundled, explain_validation_error, load, parse, save, to_dict

__all__ = [
    "TRAJECTORY_COLUMNS",
    "Positive",
    "bundled",
    "count_polygons",
    "discard",
    "discard_execution",
    "execution_summary",
    "explain_validation_error",
    "load",
    "parse",
    "read_polygons",
    "read_torque",
    "save",
    "summary",
    "to_dict",
    "write_execution",
    "write_summary",
    "write_torque",
    "write_trajectory",
]
