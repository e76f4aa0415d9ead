"""Figures: the plan as a strip of poses, the torques, the contact forces. Each draws on given axes and returns them."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Patch

from wholearm_jax.plan import Result, trajectory
from wholearm_jax.scene import Scene, body

# Okabe and Ito's colours, told apart with any colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
STYLES = ("-", "--", "-.", (0, (1, 1)))
_INK, _FILL, _PALE = "#222222", "#E8EEF4", "#999999"


def draw_pose(scene: Scene, z, ax: Axes | None = None, *, label: str = "", numbers: bool = False) -> Axes:
    """Hand and object at configuration `z`; `numbers` writes the vertices' numbers."""
    ax = ax or plt.gca()
    z = np.asarray(z)
    solid = body(scene.object)
    corners = np.asarray(solid.vertices)[: int(solid.count)]
    c, s = np.cos(z[2]), np.sin(z[2])
    outline = corners @ np.array([[c, s], [-s, c]]) + z[:2]
    joints, lengths, offsets = (np.asarray(a) for a in (scene.hand.joint, scene.hand.length, scene.hand.offset))
    ax.plot(joints[::-1, 0], [0, 0], color=_INK, lw=2.5, solid_capstyle="butt")
    ax.add_patch(Patch(outline, closed=True, facecolor=_FILL, edgecolor=_INK, lw=1.0, joinstyle="round"))
    for k, (joint, side) in enumerate(zip(joints, (1, -1), strict=True)):
        way = np.array([np.cos(z[3 + k]), np.sin(z[3 + k])])
        base = joint + offsets[k] * side * np.array([-way[1], way[0]])
        ends = np.stack([base, base + lengths[k] * way])
        ax.plot(*ends.T, color=COLOURS[k], lw=2.5, solid_capstyle="round")
        ax.plot(*joint, "o", color=COLOURS[k], ms=4)
    ax.plot(*z[:2], "+", color=_INK, ms=5)
    if numbers:
        for k, (corner, at) in enumerate(zip(corners, outline, strict=True)):
            inward = -corner / np.hypot(*corner) * 0.18 * np.abs(corners).max()
            turned = np.array([c * inward[0] - s * inward[1], s * inward[0] + c * inward[1]])
            ax.text(*(at + turned), str(k), ha="center", va="center", fontsize=6, color=_INK)
    ax.set_aspect("equal")
    ax.axis("off")
    ax.set_title(label, fontsize=8)
    return ax


def draw_strip(result: Result, poses: int = 4, axes: Sequence[Axes] | None = None) -> Figure:
    """The plan as a strip of poses (as the paper's figs. 2 and 3): `poses` for each phase, in the order of time."""
    courses = trajectory(result)
    shown = []
    for phase, course in zip(result.phases, courses, strict=False):
        rows = np.linspace(0, len(course.time) - 1, poses).round().astype(int)
        shown += [(phase.name, float(course.time[k]), np.asarray(course.z[k])) for k in rows]
    if axes is None:
        figure, grid = plt.subplots(1, len(shown), figsize=(1.6 * len(shown), 2.0), sharex=True, sharey=True, squeeze=False)
        axes = list(grid[0])
    figure = axes[0].figure
    for k, (ax, (name, time, z)) in enumerate(zip(axes, shown, strict=True)):
        draw_pose(result.scene, z, ax, label=f"{time:.2f} s", numbers=k == 0)
        if k % poses == 0:
            ax.text(0.0, -0.08, name, transform=ax.transAxes, fontsize=8, style="italic", color=_INK)
    return figure


def draw_torques(result: Result, ax: Axes | None = None) -> Axes:
    """Joint torques over time (as the paper's fig. 6)."""
    ax = ax or plt.gca()
    times, values = np.asarray(result.torque.times), np.asarray(result.torque.values)
    for k in range(2):
        ax.plot(times, values[:, k], color=COLOURS[k], ls=STYLES[k], label=f"finger {k + 1}")
    ax.set_ylabel("joint torque [N m]")
    _finish(ax, result)
    return ax


def draw_forces(result: Result, ax: Axes | None = None) -> Axes:
    """Normal contact forces over time, with the margin and its moment marked."""
    ax = ax or plt.gca()
    named = set()
    for phase, course in zip(result.phases, trajectory(result, 801), strict=False):
        for k, name in enumerate(phase.contacts):
            label = name if name not in named else None
            named.add(name)
            colour = _colour(result, name)
            ax.plot(course.time, course.cn[:, k], color=colour[0], ls=colour[1], lw=1.2, label=label)
    worst = min(result.phases, key=lambda p: p.margin)
    if np.isfinite(worst.margin):
        ax.plot(worst.margin_time, worst.margin, "o", color=_INK, ms=4, zorder=5)
        ax.axhline(worst.margin, color=_PALE, lw=0.8, zorder=0)
        left = worst.margin_time > 0.5 * float(result.torque.times[-1])
        ax.annotate(
            f"margin {worst.margin:.3g} N, {worst.margin_contact}",
            (worst.margin_time, worst.margin),
            xytext=(-6 if left else 6, -12),
            textcoords="offset points",
            ha="right" if left else "left",
            fontsize=8,
        )
    ax.set_ylabel("contact force $c_n$ [N]")
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -0.06 * high), high)
    _finish(ax, result)
    return ax


def draw_result(result: Result) -> Figure:
    """Torques above forces on one time axis."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(6.4, 5.2), sharex=True, layout="constrained")
    draw_torques(result, above).set_xlabel("")
    draw_forces(result, below)
    return figure


def _colour(result: Result, name: str):
    """A colour and a line style for each contact of the plan."""
    names = list(dict.fromkeys(n for phase in result.phases for n in phase.contacts))
    k = names.index(name)
    return (*COLOURS, "#E69F00", "#56B4E9", "#000000", "#8B6914")[k % 8], STYLES[k // 4 % 4]


def _finish(ax: Axes, result: Result) -> None:
    for phase in result.phases[1:]:
        ax.axvline(phase.start, color=_PALE, lw=0.8, ls=":")
    ax.axhline(0, color=_INK, lw=0.6)
    ax.set_xlabel("time [s]")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
