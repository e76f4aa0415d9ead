"""The traced path of a contact formation as arrays: segments, charts, nodes, and how the path ends.

Derivation: section 3 of `docs/derivation.md`.
"""

import enum
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import Status, as_device_array


class PathEnd(enum.IntEnum):
    """Why a path ends."""

    NONE = 0  # no end was found
    CONTACT_MADE = 1
    FEATURE_END = 2  # a contact leaves its feature
    TARGET = 3  # the phase's own limit is reached
    OBSTACLE = 4  # links meet, or a joint's range ends


class Resolution(NamedTuple):
    """Array sizes of a path and its table."""

    segments: int = 6  # largest number of smooth segments
    panels: int = 64  # panels of all segments together
    nodes: int = 8  # Chebyshev nodes of each panel
    max_continuation_steps: int = 256  # of up to 0.06 radians or object radii each


class PathSegments(eqx.Module):
    """The smooth segments of a path between its kinks, and their charts.

    Segment `k` covers `[breakpoints[k], breakpoints[k + 1]]`. Segments beyond `count` are empty and lie at the end.
    """

    count: Int[Array, ""]  # number of segments
    breakpoints: Float[Array, "segments_1"]  # s of the start, the kinks and the end
    chart: Float[Array, "segments 5"]  # direction u of each segment's chart
    anchor: Float[Array, "segments 5"]  # configuration about which that chart is
    anchor_s: Float[Array, "segments"]  # s there
    speed_ratio: Float[Array, "segments"]  # ds/dt after entering a segment against that before


class ContactPath(PathSegments):
    """A traced path in object units. Signs hold for forward travel."""

    status: Int[Array, ""]  # a `Status`
    start: Float[Array, "5"]  # configuration
    end: Float[Array, "5"]  # configuration
    end_reason: Int[Array, ""]  # a `PathEnd`
    end_contact: Int[Array, ""]  # row of `candidates` (made), `contacts` (at its feature's end) or `LINK_OBSTACLES`
    slip_sign: Float[Array, "segments rows"]  # Xi
    joint_sign: Float[Array, "segments 2"]
    first: Int[Array, "segments"]  # first panel of each segment
    panels: Int[Array, "segments"]  # number of panels of each segment
    segment_of_panel: Int[Array, "panels"]
    nodes: Float[Array, "panels nodes 5"]  # configurations

    @property
    def length(self) -> Float[Array, ""]:
        """The path's extent in `s`."""
        return self.breakpoints[-1] - self.breakpoints[0]


def placeholder_path(resolution: Resolution, contacts: int = 4) -> ContactPath:
    """Make a path of the right shapes without content, for ahead-of-time compilation."""
    segments, panels, nodes, _ = resolution
    fields = {name: np.zeros((segments, 5)) for name in ("chart", "anchor")}
    fields |= {name: np.zeros(segments) for name in ("anchor_s", "speed_ratio")}
    fields |= {name: np.zeros(5) for name in ("start", "end")}
    fields |= {"slip_sign": np.zeros((segments, contacts)), "joint_sign": np.zeros((segments, 2))}
    fields |= {"breakpoints": np.arange(segments + 1.0), "nodes": np.zeros((panels, nodes, 5))}
    fields |= {"first": np.zeros(segments, int), "panels": np.ones(segments, int)}
    fields |= {"segment_of_panel": np.zeros(panels, int), "count": 1, "status": int(Status.NO_CONVERGENCE)}
    fields |= {"end_reason": int(PathEnd.NONE), "end_contact": 0}
    return ContactPath(**{name: as_device_array(value) for name, value in fields.items()})


def chebyshev_points(nodes: int) -> np.ndarray:
    """Chebyshev points of the first kind on [-1, 1], increasing."""
    return -np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)
