"""Figures: poses, torques, contact forces, how a descent went.

Every function draws on the axes it is given, or on new ones, and returns them, so that figures are composed as with
matplotlib alone. Sizes of text and lines come from matplotlib's settings; `PAPER` has those of the field's papers.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon as Patch
from matplotlib.transforms import ScaledTranslation

from wholearm_jax.core import write_atomically
from wholearm_jax.model import Scene, parse_contact, rigid_body
from wholearm_jax.phases import Result, trajectory
from wholearm_jax.plotting.palette import CONTACT_COLOURS, DASHES, contact_styles
from wholearm_jax.plotting.palette import LINK_COLOURS as COLOURS

if TYPE_CHECKING:  # running it needs MuJoCo, drawing does not
    from wholearm_jax.optimisation import OptimisationResult

COLUMN, PAGE = 3.5, 7.16  # widths of one column and of two in the field's journals [inch]

PAPER: dict[Any, Any] = {
    "font.family": "STIXGeneral",  # comes with matplotlib, and looks like the journals' Times
    "mathtext.fontset": "stix",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.1,
    "pdf.fonttype": 42,  # text stays text: journals refuse other fonts
    "svg.hashsalt": "wholearm_jax",  # the same figure is the same file
}
"""Settings of matplotlib for a paper: `with plt.rc_context(PAPER)`, or `plt.rcParams.update(PAPER)` once and for all.
Figures are then `COLUMN` or `PAGE` inches wide, with letters of 7 and 8 points."""

INK, _FILL, PALE = "#222222", "#E8EEF4", "#999999"


def plot_pose(scene: Scene, z, ax: Axes | None = None, *, label: str = "", numbers: bool = False) -> Axes:
    """Hand and object at configuration `z`; `numbers` writes the vertices' numbers."""
    ax = ax or plt.gca()
    z = np.asarray(z)
    outline = outline_at(scene, z)
    joints, lengths, offsets = (np.asarray(a) for a in (scene.hand.joint, scene.hand.length, scene.hand.offset))
    ax.plot(joints[::-1, 0], [0, 0], color=INK, lw=2.5, solid_capstyle="butt")
    ax.add_patch(Patch(outline, closed=True, facecolor=_FILL, edgecolor=INK, lw=1.0, joinstyle="round"))
    for k, (joint, side) in enumerate(zip(joints, (1, -1), strict=True)):
        way = np.array([np.cos(z[3 + k]), np.sin(z[3 + k])])
        base = joint + offsets[k] * side * np.array([-way[1], way[0]])
        ends = np.stack([base, base + lengths[k] * way])
        ax.plot(*ends.T, color=COLOURS[k], lw=2.5, solid_capstyle="round")
        ax.plot(*joint, "o", color=COLOURS[k], ms=4)
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


def plot_successors(scene: Scene, z, ways, columns: int = 4, axes=None) -> np.ndarray:
    """Where each way from configuration `z` leads: its end, with the start in grey; ways that can be traced only.

    Takes and returns an array of axes, at least one a way shown.
    """
    shown = [way for way in ways if way.status.value == 0]
    axes = pose_grid(axes, max(1, -(-len(shown) // columns)), columns, 1.15)
    for ax in axes.flat:
        ax.axis("off")
    for ax, way in zip(axes.flat, shown, strict=False):
        _ghost(scene, z, ax)
        held = f"static {way.static:.2f} N" if np.isfinite(way.static) else "cannot be held"
        label = f"{' '.join(way.contacts[:2])}\n{' '.join(way.contacts[2:])}\n{way.toward}: {way.ends}\n{held}"
        plot_pose(scene, way.end, ax, label=label)
        ax.title.set_fontsize("x-small")
    return axes


def pose_grid(axes, rows: int, columns: int, ratio: float) -> np.ndarray:
    """The axes given, or new ones for poses, each so many times as high as wide."""
    if axes is not None:
        return np.asarray(axes)
    size = (PAGE, PAGE / columns * ratio * rows)
    return plt.subplots(rows, columns, figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained")[1]


def _ghost(scene: Scene, z, ax: Axes) -> None:
    """The object's outline at `z`, pale."""
    ax.add_patch(Patch(outline_at(scene, z), closed=True, facecolor="none", edgecolor=PALE, lw=0.8, ls=":"))


def outline_at(scene: Scene, z) -> np.ndarray:
    """The object's vertices `(n, 2)` in the world at configuration `z`."""
    solid = rigid_body(scene.object)
    corners = np.asarray(solid.vertices)[: int(solid.count)]
    c, s = np.cos(z[2]), np.sin(z[2])
    return corners @ np.array([[c, s], [-s, c]]) + z[:2]


def plot_strip(result: Result, poses: int = 4, axes=None) -> np.ndarray:
    """The plan as strips of poses (as the paper's figs. 2 and 3): one row a phase, time running to the right.

    Takes and returns a `(phases, poses)` array of axes.
    """
    courses = trajectory(result)
    axes = pose_grid(axes, max(len(courses), 1), poses, 0.95)
    for row, (phase, course) in enumerate(zip(result.phases, courses, strict=False)):
        shown = np.linspace(0, len(course.time) - 1, axes.shape[1]).round().astype(int)
        for column, (ax, k) in enumerate(zip(axes[row], shown, strict=True)):
            label = f"$t$ = {float(course.time[k]):.2f} s"
            plot_pose(result.scene, course.z[k], ax, label=label, numbers=row == 0 and column == 0)
        at = {"transform": axes[row, 0].transAxes, "rotation": 90, "va": "center", "ha": "right"}
        axes[row, 0].text(-0.04, 0.5, phase.name, style="italic", color=INK, **at)
    if not courses:
        plot_pose(result.scene, result.scene.start, axes[0, 0], label=result.status.label)
        for ax in axes[0, 1:]:
            ax.axis("off")
    return axes


def plot_torques(result: Result, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Joint torques [N m] over time [s] (as the paper's fig. 6), and their limits, dotted."""
    ax = ax or plt.gca()
    times, values = np.asarray(result.torque.times), np.asarray(result.torque.values)
    for k in range(2):
        ax.plot(times, values[:, k], color=COLOURS[k], ls=dashed(k), label=f"finger {k + 1}")
        limit = float(result.scene.hand.torque_limit[k])
        for sign in (1, -1):
            ax.axhline(sign * limit, color=COLOURS[k], lw=0.6, ls=":")
    ax.set_ylabel(r"torque $\tau$ [N m]")
    over_time(ax, result)
    return _legend(ax, 2) if legend else ax


def plot_forces(result: Result, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Normal contact forces [N] over time [s], with the margin and its moment marked; for contacts that roll also how
    far inside its friction cone the force is, dotted."""
    ax = ax or plt.gca()
    styles, named = contact_styles(phase.contacts for phase in result.phases), set()
    for phase, course in zip(result.phases, trajectory(result, 801), strict=False):
        for k, name in enumerate(phase.contacts):
            colour, dashes = CONTACT_COLOURS[styles[name][0]], dashed(styles[name][1])
            label = None if name in named else name
            named.add(name)
            ax.plot(course.time, course.cn[:, k], color=colour, ls=dashes, label=label)
            if name.endswith(" rolling"):
                grip = float(result.scene.object.friction[parse_contact(name)[0]])
                slack = grip * course.cn[:, k] - np.abs(course.ct[:, k])
                label = label and r"its $\mu c_n - |c_t|$"
                ax.plot(course.time, slack, color=colour, ls=":", label=label)
    ax.set_ylabel("contact force $c_n$ [N]")
    _draw_holds(result, ax)
    ax.autoscale(axis="y")  # with what other axes hold that share this one
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, 0.0) - 0.14 * (high - min(low, 0.0)), high)
    _mark_margin(result, ax)
    over_time(ax, result)
    return _legend(ax, 3) if legend else ax


def _draw_holds(result: Result, ax: Axes) -> None:
    """Times at which friction holds the object at rest, shaded, with what the contacts can bear there."""
    label: str = "held: the best least force"
    for held in (held for phase in result.phases for held in phase.holds):
        ax.axvspan(held.start, held.end, color=PALE, alpha=0.35, lw=0, zorder=0)
        if np.isfinite(held.margin):
            ax.hlines(held.margin, held.start, held.end, color=INK, lw=1.0, ls="--", label=label)
            label = "_nolegend_"


def _mark_margin(result: Result, ax: Axes) -> None:
    """A dot at the margin, and its words below the curves."""
    worst = result.critical_phase
    if not np.isfinite(worst.margin):
        return
    ax.axhline(worst.margin, color=PALE, lw=0.6, zorder=0)
    ax.plot(worst.margin_time, worst.margin, "o", color=INK, ms=3.5, zorder=5, clip_on=False)
    late = worst.margin_time > 0.5 * float(result.torque.times[-1])
    words = f"margin {worst.margin:.3g} N, {worst.margin_contact}, $t$ = {worst.margin_time:.3g} s"
    ax.annotate(
        words,
        (worst.margin_time, worst.margin),
        xytext=(0.97 if late else 0.03, 0.02),
        textcoords="axes fraction",
        ha="right" if late else "left",
        va="bottom",
        fontsize="small",
        arrowprops={"arrowstyle": "-", "color": INK, "lw": 0.5, "shrinkA": 0, "shrinkB": 2},
    )


def plot_result(result: Result, axes=None) -> np.ndarray:
    """Torques above forces on one time axis; takes and returns two axes."""
    if axes is None:
        _, axes = plt.subplots(2, 1, figsize=(COLUMN, 3.9), sharex=True, layout="constrained", height_ratios=(2, 3))
    plot_torques(result, axes[0], legend=False).set_xlabel("")
    plot_forces(result, axes[1]).set_title("")
    _legend(axes[0], 2)
    for words in axes[1].texts:
        words.set_visible(words.get_style() != "italic")  # the phases' names stand above the torques
    return axes


def plot_history(found: OptimisationResult, ax: Axes | None = None) -> Axes:
    """The least force [N] over the steps of the descent, a curve for each start of each phase, and the bounds."""
    ax = ax or plt.gca()
    for phase in range(len(found.bounds)):
        colour = CONTACT_COLOURS[1:][phase % (len(CONTACT_COLOURS) - 1)]
        steps = [step for step in found.history if step.phase == phase]
        if not steps:
            continue  # it is optimised together with the phase before it
        for start in sorted({step.start for step in steps}):
            curve = [(step.iteration, step.margin) for step in steps if step.start == start]
            label = found.result.phases[phase].name if start == steps[0].start else None
            ax.plot(*np.transpose(curve), color=colour, ls=dashed(start % len(DASHES)), label=label)
        ax.axhline(float(found.bounds[phase].value), color=colour, lw=0.6, ls=":")
    ax.set_xlabel("step of the descent")
    ax.set_ylabel("least force [N]")
    ax.spines[["top", "right"]].set_visible(False)
    return _legend(ax, 2)


def save_figure(draw: Callable[[], Any], folder: Path, name: str) -> None:
    """Draw with the settings of a paper; write it to look at, and as vectors for the web and for print."""
    with plt.rc_context(PAPER):
        figure = np.ravel(draw())[0].figure
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once is enough for every format
        for kind, undated in (("png", {}), ("svg", {"Date": None}), ("pdf", {"CreationDate": None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=250, bbox_inches="tight", metadata=undated)
            write_atomically(folder / f"{name}.{kind}", buffer.getvalue())
        plt.close(figure)


def dashed(number: int):
    """A line style of the palette, as matplotlib writes it."""
    return (0, DASHES[number]) if DASHES[number] else "-"


def over_time(ax: Axes, result: Result, *, named: bool = True, zero: bool = True) -> None:
    """Time axis, phases and frame of a plot over time."""
    for phase in result.phases:
        ax.axvline(phase.start, color=PALE, lw=0.6, ls=":")
        middle, over = phase.start + phase.duration / 2, ax.get_xaxis_transform()
        if named:
            ax.text(middle, 1.01, phase.name, transform=over, ha="center", va="bottom", style="italic")
    if zero:
        ax.axhline(0, color=INK, lw=0.6)
    ax.set_xlim(0, result.phases[-1].start + result.phases[-1].duration)
    ax.set_xlabel("time $t$ [s]")
    ax.spines[["top", "right"]].set_visible(False)


def _legend(ax: Axes, columns: int) -> Axes:
    """A legend below everything else of an axis, where it hides nothing."""
    points = 25 if ax.get_xlabel() else 5
    below = ax.transAxes + ScaledTranslation(0, -points / 72, ax.figure.dpi_scale_trans)
    place = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "bbox_transform": below}
    ax.legend(frameon=False, ncols=columns, columnspacing=1.2, handlelength=2.4, **place)
    return ax
