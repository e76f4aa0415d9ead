"""Levels of effort, statuses and reasons, and the records that the stability sweep keeps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.stability import checks
from benchmarks.stability.scenes import Scenes

STATUSES = (
    *("ok", "contact_lost", "stuck", "reversed", "not_reached", "left_formation", "ambiguous", "singular"),
    *("no_convergence", "max_steps", "obstacle"),
)
REASONS = (
    "",
    "contacts do not touch",
    "start out of place",
    "heading names a still coordinate",
    "rank lost",
    "wedged by friction",
    "end or kink not located",
    "table too coarse",
    "path too long",
    "links overlap at the start",
    "path without a length",
)
NONE, APART, MISPLACED, STILL, RANK, WEDGED, ASTRAY, COARSE, LONG, OVERLAP, EMPTY = range(len(REASONS))


class Level(NamedTuple):
    """How finely paths are tabulated, steps and tolerance of a phase, and how many scenes share a program's run."""

    segments: int
    panels: int
    steps: int
    tolerance: float
    lanes: int


class Precision(NamedTuple):
    """Levels, the largest interpolation error of a table, and what counts as wrong."""

    levels: tuple[Level, ...]
    coarse: float
    limits: checks.Limits


DOUBLE = Precision(
    (Level(6, 64, 128, 1e-10, 64), Level(48, 512, 2048, 1e-12, 8), Level(48, 512, 16384, 1e-12, 4)),
    1e-9,
    checks.DOUBLE,
)
SINGLE = Precision(
    (Level(6, 64, 128, 1e-5, 64), Level(48, 512, 2048, 1e-5, 8)),
    1e-3,
    checks.SINGLE,
)


RESIDUALS = ("closure", "tangent", "columns", "seam", "motion", "constraint", "energy", "gradient")
EXCESSES = ("sign", "beyond", "depth", "margin_excess", "tension_missed", "overlap", "thickness")


def blank(scenes: Scenes):
    """Records before anything is known."""
    n = len(scenes.count)
    whole = ("status", "table_status", "reason", "violations", "level", "steps", "path_end", "pieces")
    real = ("margin", "scale", "condition", "table_error", "length", "travel", "end_share", *RESIDUALS, *EXCESSES)
    found = {name: np.zeros(n, int) for name in whole} | {name: np.full(n, np.nan) for name in real}
    found |= {"torque": np.zeros((n, *scenes.noise.shape[1:])), "moved": np.zeros(n, bool)}
    return found | {
        "family": scenes.family,
        "exact": scenes.exact,
        "at_rest": scenes.at_rest,
        "layered": scenes.layered,
    }


def picked(tree, rows):
    """Some rows of arrays with a leading axis."""
    return jax.tree.map(lambda a: a[rows], tree)


def batches(count, lanes):
    """Row numbers in batches of one size; the last is filled up with repetitions, `real` says how many are not."""
    for first in range(0, count, lanes):
        rows = np.arange(first, min(first + lanes, count))
        yield np.resize(rows, lanes), len(rows)


def to_device(tree):
    """NumPy to JAX, floats in JAX's default precision."""
    return jax.tree.map(lambda a: jnp.asarray(a, float if a.dtype.kind == "f" else None), tree)


def flag(found, rows, name, wrong):
    """Note a violation."""
    found["violations"][rows] |= np.where(wrong, 1 << checks.VIOLATIONS.index(name), 0)
