"""TOML scenes, outlines of drawings, CSV and JSON results, NPZ polygons, and the Zarr store of checks."""

from wholearm_jax.files.controller_json import controller_to_dict, read_controller, write_controller
from wholearm_jax.files.execution_results import execution_summary, write_execution
from wholearm_jax.files.file_set import EXECUTION_FILES, RESULT_FILES, FileSet, is_ok, replace_files
from wholearm_jax.files.outline_scene import describe_choice, outline_tables, scene_from_outline, scene_text
from wholearm_jax.files.outlines import Outline, choose_outline, describe_outline, read_outline, read_outlines
from wholearm_jax.files.polygons_npz import count_polygons, read_polygons
from wholearm_jax.files.results import (
    TRAJECTORY_COLUMNS,
    null_for_undefined,
    summary,
    write_summary,
    write_torque,
    write_trajectory,
)
from wholearm_jax.files.scene_schema import Positive, explain_validation_error
from wholearm_jax.files.scene_toml import bundled, load, load_goal, load_start, parse, parse_start, save, to_dict
from wholearm_jax.files.torque_csv import read_torque

__all__ = [
    "EXECUTION_FILES",
    "RESULT_FILES",
    "TRAJECTORY_COLUMNS",
    "FileSet",
    "Outline",
    "Positive",
    "bundled",
    "choose_outline",
    "controller_to_dict",
    "count_polygons",
    "describe_choice",
    "describe_outline",
    "execution_summary",
    "explain_validation_error",
    "is_ok",
    "load",
    "load_goal",
    "load_start",
    "null_for_undefined",
    "outline_tables",
    "parse",
    "parse_start",
    "read_controller",
    "read_outline",
    "read_outlines",
    "read_polygons",
    "read_torque",
    "replace_files",
    "save",
    "scene_from_outline",
    "scene_text",
    "summary",
    "to_dict",
    "write_controller",
    "write_execution",
    "write_summary",
    "write_torque",
    "write_trajectory",
]
