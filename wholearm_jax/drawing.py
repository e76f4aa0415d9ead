"""Figures: the plan as a strip of poses, the torques, the contact forces. Each draws on given axes and returns them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Patch

from wholearm_jax.plan import Result, trajectory
from wholearm_jax.scene import Scene, body, parse_contact

if TYPE_CHECKING:  # running it needs MuJoCo, drawing does not
    from wholearm_jax.execution import Execution

# Okabe and Ito's colours, told apart with any colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
STYLES = ("-", "--", "-.", (0, (1, 1)))
_INK, _FILL, _PALE = "#222222", "#E8EEF4", "#999999"


def draw_pose(scene: Scene, z, ax: Axes | None = None, *, label: str = "", numbers: bool = False) -> Axes:
    """Hand and object at configuration `z`; `numbers` writes the vertices' numbers."""
    ax = ax or plt.gca()
    z = np.asarray(z)
    outline = _outline(scene, z)
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
        inward = z[:2] - outline
        size = 0.3 * np.abs(inward).max()
        for k, (x, y) in enumerate(outline + size * inward / np.hypot(*inward.T)[:, None]):
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
    ax.add_patch(Patch(_outline(scene, z), closed=True, facecolor="none", edgecolor=_PALE, lw=0.8, ls=":"))


def _outline(scene: Scene, z) -> np.ndarray:
    """The object's vertices `(n, 2)` in the world at configuration `z`."""
    solid = body(scene.object)
    corners = np.asarray(solid.vertices)[: int(solid.count)]
    c, s = np.cos(z[2]), np.sin(z[2])
    return corners @ np.array([[c, s], [-s, c]]) + z[:2]


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
    _draw_holds(result, ax)
    worst = result.hardest
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


def _draw_holds(result: Result, ax: Axes) -> None:
    """Times at which friction holds the object at rest, shaded, with what the contacts can bear there."""
    label: str = "held: the best least force"
    for held in (held for phase in result.phases for held in phase.holds):
        ax.axvspan(held.start, held.end, color=_PALE, alpha=0.35, lw=0, zorder=0)
        if np.isfinite(held.margin):
            ax.hlines(held.margin, held.start, held.end, color=_INK, lw=1.0, ls="--", label=label)
            label = "_nolegend_"


def draw_result(result: Result) -> Figure:
    """Torques above forces on one time axis."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(6.4, 5.2), sharex=True, layout="constrained")
    draw_torques(result, above).set_xlabel("")
    draw_forces(result, below)
    return figure


def draw_execution(execution: Execution) -> Figure:
    """An execution on top of its prediction: contact forces, deviation of the object, and which contacts touch."""
    rows = {"height_ratios": [3, 1.2, 0.22 * len(execution.planned) + 0.3]}
    figure, (forces, off, touch) = plt.subplots(
        3, 1, figsize=(6.8, 7.0), sharex=True, layout="constrained", gridspec_kw=rows
    )
    _overlay_forces(execution, forces)
    _draw_deviation(execution, off)
    _draw_touch(execution, touch)
    for ax in (forces, off, touch):
        for phase in execution.prediction.phases:
            ax.axvline(phase.start, color=_PALE, lw=0.8, ls=":")
        ax.spines[["top", "right"]].set_visible(False)
    for phase in execution.prediction.phases:
        middle, over = phase.start + phase.duration / 2, forces.get_xaxis_transform()
        forces.text(middle, 1.01, phase.name, transform=over, ha="center", va="bottom", fontsize=8, style="italic")
    touch.set_xlabel("time [s]")
    return figure


def draw_execution_strip(execution: Execution, poses: int = 8) -> Figure:
    """An execution as a strip of poses, the predicted object dashed."""
    columns = (poses + 1) // 2
    figure, grid = plt.subplots(
        2, columns, figsize=(1.7 * columns, 3.5), sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    shown = np.linspace(0, len(execution.course.time) - 1, 2 * columns).round().astype(int)
    for ax, row in zip(grid.flat, shown, strict=True):
        _draw_moment(execution, row, ax)
    return figure


def animate(execution: Execution, frames_per_second: int = 25) -> FuncAnimation:
    """An execution in real time, the predicted object dashed."""
    times = execution.course.time
    count = max(2, round(times[-1] * frames_per_second) + 1)
    shown = np.searchsorted(times, np.linspace(0, times[-1], count) - 1e-9)
    figure, ax = plt.subplots(figsize=(4.8, 3.6), layout="constrained")
    reach = np.asarray(execution.prediction.scene.hand.length).max()
    across = np.abs(np.asarray(execution.prediction.scene.hand.joint)[:, 0]).max() + reach

    def show(row):
        ax.clear()
        _draw_moment(execution, row, ax)
        ax.set_xlim(-across, across)
        ax.set_ylim(-0.1 * reach, 1.2 * reach)
        return ()

    return FuncAnimation(figure, show, frames=shown, interval=1000 / frames_per_second)


def _draw_moment(execution: Execution, row: int, ax: Axes) -> None:
    """The executed pose of one step, and the predicted object's outline."""
    time = execution.course.time[row]
    draw_pose(execution.prediction.scene, execution.course.z[row], ax, label=f"t = {time:.2f} s")
    expected = execution.expected
    if time <= expected.time[-1] + 1e-9:
        z = expected.z[min(np.searchsorted(expected.time, time - 1e-9), len(expected.time) - 1)]
        outline = _outline(execution.prediction.scene, z)
        ax.add_patch(Patch(outline, closed=True, fill=False, edgecolor=COLOURS[1], lw=0.8, ls="--", zorder=4))


def _overlay_forces(execution: Execution, ax: Axes) -> None:
    expected = execution.expected
    for name in execution.planned:
        column = execution.names.index(name)
        colour = _colour(execution.prediction, name)[0]
        predicted = np.where(expected.cn[:, column] == 0, np.nan, expected.cn[:, column])
        ax.plot(expected.time, predicted, color=colour, lw=3.5, alpha=0.35, solid_capstyle="butt")
        executed = execution.course.cn[:, column]
        ax.plot(execution.course.time, np.where(executed > 0, executed, np.nan), color=colour, lw=0.9, label=name)
    high = np.nanmax(np.where(np.isfinite(expected.cn), expected.cn, 0.0))
    ax.set_ylim(-0.03 * high, 1.35 * high)
    ax.axhline(0, color=_INK, lw=0.6)
    ax.plot([], [], color=_PALE, lw=3.5, alpha=0.6, label="predicted")
    ax.set_ylabel("contact force $c_n$ [N]")
    ax.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _draw_deviation(execution: Execution, ax: Axes) -> None:
    course, expected = execution.course, execution.expected
    z = np.stack([np.interp(expected.time, course.time, course.z[:, k]) for k in range(3)], axis=1)
    off = z - expected.z[:, :3]
    corners = np.asarray(body(execution.prediction.scene.object).vertices)
    rim = 1e3 * np.hypot(*corners.T).max() * np.abs(off[:, 2])
    ax.plot(expected.time, 1e3 * np.hypot(off[:, 0], off[:, 1]), color=COLOURS[0], lw=1.2, label="centre of mass")
    ax.plot(expected.time, rim, color=COLOURS[1], lw=1.2, ls="--", label="angle, at its rim")
    ax.set_ylim(bottom=0)
    ax.set_ylabel("deviation [mm]")
    ax.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _draw_touch(execution: Execution, ax: Axes) -> None:
    """A pale bar while a contact is predicted to touch, and a full one within it while it does."""
    shown = [n for n in execution.names if n in execution.planned or _touches(execution, n)]
    for place, name in enumerate(shown):
        column = execution.names.index(name)
        known = name in execution.planned
        colour = _colour(execution.prediction, name)[0] if known else _INK
        for course, height, alpha in ((execution.expected, 0.8, 0.35), (execution.course, 0.3, 1.0)):
            for begin, end in _spans(course.time, course.touch[:, column]):
                ax.barh(place, end - begin, left=begin, height=height, color=colour, alpha=alpha, lw=0)
    ax.set_yticks(range(len(shown)), shown, fontsize=8)
    ax.invert_yaxis()


def _touches(execution: Execution, name: str) -> bool:
    column = execution.names.index(name)
    return bool(execution.course.touch[:, column].any() or execution.expected.touch[:, column].any())


def _spans(times, flags):
    """Intervals of time in which a flag holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    last = len(times) - 1
    return [(times[begin], times[min(end, last)]) for begin, end in edges.reshape(-1, 2)]


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
