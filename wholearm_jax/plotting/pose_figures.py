"""Figures of poses: the hand and the object at one configuration, along a plan, and where a configuration can lead."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon as Patch
from shapely import LineString, Point
from shapely import Polygon as ShapelyPolygon

from wholearm_jax.model import Scene, rigid_body
from wholearm_jax.phases import Result, describe_overlaps, trajectory
from wholearm_jax.plotting.palette import LINK_COLOURS as COLOURS
from wholearm_jax.plotting.style import ALARM, FILL, INK, PAGE, PALE, whole_figure

POSES_IN_ROW = 5


def plot_pose(
    scene: Scene, z, ax: Axes | None = None, *, label: str = "", numbers: bool = False, tolerance: float = 1e-9
) -> Axes:
    """The hand and the object at configuration `z` [m, rad]; `numbers` labels the vertices.

    Overlaps deeper than `tolerance`, in the object's radius or radians, are marked.
    """
    ax = ax or plt.gca()
    z = np.asarray(z)
    outline = object_outline(scene, z)
    joints, lengths, offsets = (np.asarray(a) for a in (scene.hand.joint, scene.hand.length, scene.hand.offset))
    ax.plot(joints[::-1, 0], [0, 0], color=INK, lw=2.5, solid_capstyle="butt", clip_on=False)
    ax.add_patch(Patch(outline, closed=True, facecolor=FILL, edgecolor=INK, lw=1.0, joinstyle="round"))
    segments = []
    for k, (joint, side) in enumerate(zip(joints, (1, -1), strict=True)):
        direction = np.array([np.cos(z[3 + k]), np.sin(z[3 + k])])
        base = joint + offsets[k] * side * np.array([-direction[1], direction[0]])
        ends = np.stack([base, base + lengths[k] * direction])
        segments.append(ends)
        ax.plot(*ends.T, color=COLOURS[k], lw=2.5, solid_capstyle="round")
        ax.plot(*joint, "o", color=COLOURS[k], ms=4, clip_on=False)
    _mark_overlaps(scene, z, outline, segments, ax, tolerance)
    ax.plot(z[0], z[1], "+", color=INK, ms=5)
    if numbers:
        inward = z[:2] - outline
        size = 0.3 * np.abs(inward).max()
        for k, (x, y) in enumerate(outline + size * inward / np.hypot(*inward.T)[:, None]):
            ax.text(x, y, str(k), ha="center", va="center", fontsize="x-small", color=INK, zorder=6)
    ax.set_aspect("equal")
    ax.axis("off")
    ax.set_title(label)
    return ax


def plot_strip(result: Result, poses: int = 4, axes=None) -> np.ndarray:
    """The plan as strips of poses (as the paper's figs. 2 and 3): one row a phase, time running to the right.

    Takes and returns a `(phases, poses)` array of axes.
    """
    motions, given = trajectory(result), axes
    axes = pose_grid(axes, max(len(motions), 1), poses, 0.95)
    for row, (phase, motion) in enumerate(zip(result.phases, motions, strict=False)):
        shown = np.linspace(0, len(motion.time) - 1, axes.shape[1]).round().astype(int)
        for column, (ax, k) in enumerate(zip(axes[row], shown, strict=True)):
            label = f"$t$ = {float(motion.time[k]):.2f} s"
            plot_pose(result.scene, motion.z[k], ax, label=label, numbers=row == 0 and column == 0)
        placement = {"transform": axes[row, 0].transAxes, "rotation": 90, "va": "center", "ha": "right"}
        axes[row, 0].text(-0.04, 0.5, phase.name, style="italic", color=INK, **placement)
    if not motions:
        plot_pose(result.scene, result.scene.start, axes[0, 0], label=result.status.label)
        for ax in axes[0, 1:]:
            ax.axis("off")
    if given is None:
        _fit_height(axes, lines=1)
    return axes


def _mark_overlaps(scene: Scene, z, outline, segments, ax: Axes, tolerance: float) -> None:
    """Mark where links lie in one another or in the object, with the pair and the depth in words."""
    lines = describe_overlaps(scene, z, tolerance)
    if not lines:
        return
    first, second = (LineString(ends) for ends in segments)
    inside = ShapelyPolygon(outline).buffer(-1e-9 * np.ptp(outline))
    for part in (first.intersection(inside), second.intersection(inside)):
        if part.length > 0:
            ax.plot(*np.asarray(part.coords).T, color=ALARM, lw=4, zorder=5)
    crossing = first.intersection(second)
    if isinstance(crossing, Point) and not bool(scene.hand.layered):
        ax.plot(crossing.x, crossing.y, "x", color=ALARM, ms=9, mew=2, zorder=6)
    at = {"transform": ax.transAxes, "ha": "center", "va": "top", "fontsize": "x-small", "color": ALARM}
    ax.text(0.5, 0.0, "\n".join(lines), **at)


def plot_successors(scene: Scene, z, successors, columns: int = 4, axes=None) -> np.ndarray:
    """The end of each phase that can follow configuration `z`, with the start in grey.

    Shows the `successors` whose path could be traced. Takes and returns an array of axes, at least one for each.
    """
    shown = [s for s in successors if s.status.value == 0]
    if not shown:  # the configuration itself, with what is in the way
        axes = pose_grid(axes, 1, 1, 1.15)
        plot_pose(scene, z, axes.flat[0], label="nothing can begin here", numbers=True)
        return axes
    axes = pose_grid(axes, max(1, -(-len(shown) // columns)), columns, 1.15)
    for ax in axes.flat:
        ax.axis("off")
    for ax, successor in zip(axes.flat, shown, strict=False):
        _plot_start_outline(scene, z, ax)
        rest = f"static {successor.static:.2f} N" if np.isfinite(successor.static) else "cannot be held"
        contacts = " ".join(successor.contacts[:2]), " ".join(successor.contacts[2:])
        label = "\n".join((*contacts, f"{successor.toward}: {successor.ends}", rest))
        plot_pose(scene, successor.end, ax, label=label)
        ax.title.set_fontsize("x-small")
    return axes


def plot_plan_poses(scene: Scene, begins, ends, axes=None) -> np.ndarray:
    """Plot where each phase of a plan ends, with where it begins in grey; the start comes first.

    Args:
        scene: the plan.
        begins: `z` (5,) at the start of each phase.
        ends: `z` (5,) at the end of each phase.
        axes: an array of axes, one more than phases; new ones unless given.

    Returns:
        The axes.
    """
    given, columns = axes, min(len(ends) + 1, POSES_IN_ROW)
    axes = pose_grid(axes, -(-(len(ends) + 1) // columns), columns, 1.15)
    for ax in axes.flat[len(ends) + 1 :]:
        ax.axis("off")
    plot_pose(scene, begins[0], axes.flat[0], label="start", numbers=True).title.set_fontsize("x-small")
    for k, (ax, begin, end) in enumerate(zip(axes.flat[1:], begins, ends, strict=False)):
        _plot_start_outline(scene, begin, ax)
        contacts = scene.phases[k].formation.names
        plot_pose(scene, end, ax, label=f"{k + 1}: {' '.join(contacts[:2])}\n{' '.join(contacts[2:])}")
        ax.title.set_fontsize("x-small")
    if given is None:
        _fit_height(axes, lines=2)
    return axes


def _fit_height(axes: np.ndarray, lines: int) -> None:
    """Make a figure as high as its poses and `lines` of title above each row of them."""
    (left, right), (low, high) = axes.flat[0].get_xlim(), axes.flat[0].get_ylim()
    rows, columns = axes.shape
    title = (1.5 * lines + 1) * axes.flat[0].title.get_fontsize() / 72
    height = PAGE / columns * (high - low) / (right - left) + title
    whole_figure(axes.flat[0]).set_size_inches(PAGE, rows * height)


def pose_grid(axes, rows: int, columns: int, ratio: float) -> np.ndarray:
    """Return `axes` as an array, or make new ones for poses; `ratio` is the height of each over its width."""
    if axes is not None:
        return np.asarray(axes)
    size = (PAGE, PAGE / columns * ratio * rows)
    return plt.subplots(rows, columns, figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained")[1]


def object_outline(scene: Scene, z) -> np.ndarray:
    """Return the object's vertices `(n, 2)` [m] in the world at configuration `z`."""
    body = rigid_body(scene.object)
    corners = np.asarray(body.vertices)[: int(body.count)]
    x, y, phi = np.asarray(z)[:3]
    c, s = np.cos(phi), np.sin(phi)
    return corners @ np.array([[c, s], [-s, c]]) + (x, y)


def _plot_start_outline(scene: Scene, z, ax: Axes) -> None:
    """Plot the object's outline at `z`, pale."""
    ax.add_patch(Patch(object_outline(scene, z), closed=True, facecolor="none", edgecolor=PALE, lw=0.8, ls=":"))
