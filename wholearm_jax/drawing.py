"""Figures: the plan as a strip of poses, the torques, the contact forces. Each draws on given axes and returns them."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Patch

from wholearm_jax.plan import Result, trajectory
from wholearm_jax.scene import Scene, body, parse_contact

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
    ax.plot(z[0], z[1], "+", color=_INK, ms=5)
    if numbers:
        for k, (corner, at) in enumerate(zip(corners, outline, strict=True)):
            inward = -corner / np.hypot(*corner) * 0.3 * np.abs(corners).max()
            turned = np.array([c * inward[0] - s * inward[1], s * inward[0] + c * inward[1]])
            x, y = at + turned
            ax.text(x, y, str(k), ha="center", va="center", fontsize=6, color=_INK, zorder=6)
    ax.set_aspect("equal")
    ax.axis("off")
    ax.set_title(label, fontsize=8)
    return ax


def draw_ways(scene: Scene, z, ways, columns: int = 4) -> Figure:
    """Where each way from configuration `z` leads: its end, with the start in grey; ways that can be traced only."""
    shown = [way for way in ways if way.status.value == 0]
    rows = max(1, -(-len(shown) // columns))
    size = (1.9 * columns, 2.0 * rows)
    figure, grid = plt.subplots(
        rows, columns, figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    for ax in grid.flat:
        ax.axis("off")
    for ax, way in zip(grid.flat, shown, strict=False):
        _ghost(scene, z, ax)
        held = f"static {way.static:.2f} N" if np.isfinite(way.static) else "cannot be held"
        label = f"{' '.join(way.contacts[:2])}\n{' '.join(way.contacts[2:])}\n{way.toward}: {way.ends}\n{held}"
        draw_pose(scene, way.end, ax, label=label)
        ax.title.set_fontsize(6)
    return figure


def _ghost(scene: Scene, z, ax: Axes) -> None:
    """The object's outline at `z`, pale."""
    z = np.asarray(z)
    solid = body(scene.object)
    corners = np.asarray(solid.vertices)[: int(solid.count)]
    c, s = np.cos(z[2]), np.sin(z[2])
    outline = corners @ np.array([[c, s], [-s, c]]) + z[:2]
    ax.add_patch(Patch(outline, closed=True, facecolor="none", edgecolor=_PALE, lw=0.8, ls=":"))


def draw_strip(result: Result, poses: int = 4) -> Figure:
    """The plan as strips of poses (as the paper's figs. 2 and 3): one row a phase, time running to the right."""
    courses = trajectory(result)
    rows = max(len(courses), 1)
    size = (1.7 * poses, 1.75 * rows)
    figure, grid = plt.subplots(
        rows, poses, figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    for row, (phase, course) in enumerate(zip(result.phases, courses, strict=False)):
        shown = np.linspace(0, len(course.time) - 1, poses).round().astype(int)
        for column, (ax, k) in enumerate(zip(grid[row], shown, strict=True)):
            label = f"t = {float(course.time[k]):.2f} s"
            draw_pose(result.scene, course.z[k], ax, label=label, numbers=row == 0 and column == 0)
        at = {"transform": grid[row, 0].transAxes, "rotation": 90, "va": "center", "ha": "right"}
        grid[row, 0].text(-0.04, 0.5, phase.name, fontsize=9, style="italic", color=_INK, **at)
    if not courses:
        draw_pose(result.scene, result.scene.start, grid[0, 0], label=result.status.label)
        for ax in grid[0, 1:]:
            ax.axis("off")
    return figure


def draw_torques(result: Result, ax: Axes | None = None) -> Axes:
    """Joint torques over time (as the paper's fig. 6)."""
    ax = ax or plt.gca()
    times, values = np.asarray(result.torque.times), np.asarray(result.torque.values)
    for k in range(2):
        ax.plot(times, values[:, k], color=COLOURS[k], ls=STYLES[k], label=f"finger {k + 1}")
        limit = float(result.scene.hand.torque_limit[k])
        for sign in (1, -1):
            ax.axhline(sign * limit, color=COLOURS[k], lw=0.6, ls=":")
    ax.set_ylabel("joint torque [N m]")
    _finish(ax, result)
    return ax


def draw_forces(result: Result, ax: Axes | None = None) -> Axes:
    """Normal contact forces over time, with the margin and its moment marked; for contacts that roll also how far
    inside its friction cone the force is, dotted."""
    ax = ax or plt.gca()
    named = set()
    for phase, course in zip(result.phases, trajectory(result, 801), strict=False):
        for k, name in enumerate(phase.contacts):
            label = name if name not in named else None
            named.add(name)
            colour = _colour(result, name)
            ax.plot(course.time, course.cn[:, k], color=colour[0], ls=colour[1], lw=1.2, label=label)
            if name.endswith(" rolling"):
                grip = float(result.scene.object.friction[parse_contact(name)[0]])
                slack = grip * course.cn[:, k] - np.abs(course.ct[:, k])
                label = label and r"$\mu c_n - |c_t|$ of it"
                ax.plot(course.time, slack, color=colour[0], ls=":", lw=1.6, label=label)
    worst = min(result.phases, key=lambda p: p.margin)
    if np.isfinite(worst.margin):
        ax.plot(worst.margin_time, worst.margin, "o", color=_INK, ms=4, zorder=5)
        ax.axhline(worst.margin, color=_PALE, lw=0.8, zorder=0)
        left = worst.margin_time > 0.5 * float(result.torque.times[-1])
        ax.annotate(
            f"margin {worst.margin:.3g} N, {worst.margin_contact}",
            (worst.margin_time, worst.margin),
            xytext=(-8 if left else 8, 10),
            textcoords="offset points",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85},
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
    return ("#000000", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#8B6914", "#0072B2", "#D55E00")[k % 8], STYLES[
        k // 4 % 4
    ]


def _finish(ax: Axes, result: Result) -> None:
    for phase in result.phases:
        ax.axvline(phase.start, color=_PALE, lw=0.8, ls=":")
        middle, over = phase.start + phase.duration / 2, ax.get_xaxis_transform()
        ax.text(middle, 1.01, phase.name, transform=over, ha="center", va="bottom", fontsize=8, style="italic")
    ax.axhline(0, color=_INK, lw=0.6)
    ax.set_xlabel("time [s]")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
