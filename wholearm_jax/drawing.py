"""Figures: poses, torques, contact forces, how a descent went, executions.

Every function draws on the axes it is given, or on new ones, and returns them, so that figures are composed as with
matplotlib alone. Sizes of text and lines come from matplotlib's settings; `PAPER` has those of the field's papers.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.patches import Polygon as Patch
from matplotlib.transforms import ScaledTranslation

from wholearm_jax.palette import CONTACT_COLOURS, DASHES, contact_styles
from wholearm_jax.palette import LINK_COLOURS as COLOURS
from wholearm_jax.plan import Result, trajectory
from wholearm_jax.scene import Scene, body, parse_contact
from wholearm_jax.status import Status
from wholearm_jax.survey import Survey
from wholearm_jax.writing import write_whole

if TYPE_CHECKING:  # running it needs MuJoCo, drawing does not
    from wholearm_jax.execution import Execution
    from wholearm_jax.optimiser import Optimised

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

_INK, _FILL, _PALE = "#222222", "#E8EEF4", "#999999"
_HOLDS, _FATES = "#009E73", ("#D55E00", "#E69F00", "#56B4E9", "#CC79A7", "#8B6914", "#999999")  # of scenes in a survey


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
            ax.text(x, y, str(k), ha="center", va="center", fontsize="x-small", color=_INK, zorder=6)
    ax.set_aspect("equal")
    ax.axis("off")
    ax.set_title(label)
    return ax


def draw_ways(scene: Scene, z, ways, columns: int = 4, axes=None) -> np.ndarray:
    """Where each way from configuration `z` leads: its end, with the start in grey; ways that can be traced only.

    Takes and returns an array of axes, at least one a way shown.
    """
    shown = [way for way in ways if way.status.value == 0]
    axes = _grid(axes, max(1, -(-len(shown) // columns)), columns, 1.15)
    for ax in axes.flat:
        ax.axis("off")
    for ax, way in zip(axes.flat, shown, strict=False):
        _ghost(scene, z, ax)
        held = f"static {way.static:.2f} N" if np.isfinite(way.static) else "cannot be held"
        label = f"{' '.join(way.contacts[:2])}\n{' '.join(way.contacts[2:])}\n{way.toward}: {way.ends}\n{held}"
        draw_pose(scene, way.end, ax, label=label)
        ax.title.set_fontsize("x-small")
    return axes


def _grid(axes, rows: int, columns: int, ratio: float) -> np.ndarray:
    """The axes given, or new ones for poses, each so many times as high as wide."""
    if axes is not None:
        return np.asarray(axes)
    size = (PAGE, PAGE / columns * ratio * rows)
    return plt.subplots(rows, columns, figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained")[1]


def _ghost(scene: Scene, z, ax: Axes) -> None:
    """The object's outline at `z`, pale."""
    ax.add_patch(Patch(_outline(scene, z), closed=True, facecolor="none", edgecolor=_PALE, lw=0.8, ls=":"))


def _outline(scene: Scene, z) -> np.ndarray:
    """The object's vertices `(n, 2)` in the world at configuration `z`."""
    solid = body(scene.object)
    corners = np.asarray(solid.vertices)[: int(solid.count)]
    c, s = np.cos(z[2]), np.sin(z[2])
    return corners @ np.array([[c, s], [-s, c]]) + z[:2]


def draw_strip(result: Result, poses: int = 4, axes=None) -> np.ndarray:
    """The plan as strips of poses (as the paper's figs. 2 and 3): one row a phase, time running to the right.

    Takes and returns a `(phases, poses)` array of axes.
    """
    courses = trajectory(result)
    axes = _grid(axes, max(len(courses), 1), poses, 0.95)
    for row, (phase, course) in enumerate(zip(result.phases, courses, strict=False)):
        shown = np.linspace(0, len(course.time) - 1, axes.shape[1]).round().astype(int)
        for column, (ax, k) in enumerate(zip(axes[row], shown, strict=True)):
            label = f"$t$ = {float(course.time[k]):.2f} s"
            draw_pose(result.scene, course.z[k], ax, label=label, numbers=row == 0 and column == 0)
        at = {"transform": axes[row, 0].transAxes, "rotation": 90, "va": "center", "ha": "right"}
        axes[row, 0].text(-0.04, 0.5, phase.name, style="italic", color=_INK, **at)
    if not courses:
        draw_pose(result.scene, result.scene.start, axes[0, 0], label=result.status.label)
        for ax in axes[0, 1:]:
            ax.axis("off")
    return axes


def draw_torques(result: Result, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Joint torques [N m] over time [s] (as the paper's fig. 6), and their limits, dotted."""
    ax = ax or plt.gca()
    times, values = np.asarray(result.torque.times), np.asarray(result.torque.values)
    for k in range(2):
        ax.plot(times, values[:, k], color=COLOURS[k], ls=_dashed(k), label=f"finger {k + 1}")
        limit = float(result.scene.hand.torque_limit[k])
        for sign in (1, -1):
            ax.axhline(sign * limit, color=COLOURS[k], lw=0.6, ls=":")
    ax.set_ylabel(r"torque $\tau$ [N m]")
    _finish(ax, result)
    return _legend(ax, 2) if legend else ax


def draw_forces(result: Result, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Normal contact forces [N] over time [s], with the margin and its moment marked; for contacts that roll also how
    far inside its friction cone the force is, dotted."""
    ax = ax or plt.gca()
    styles, named = contact_styles(phase.contacts for phase in result.phases), set()
    for phase, course in zip(result.phases, trajectory(result, 801), strict=False):
        for k, name in enumerate(phase.contacts):
            colour, dashes = CONTACT_COLOURS[styles[name][0]], _dashed(styles[name][1])
            label = None if name in named else name
            named.add(name)
            ax.plot(course.time, course.cn[:, k], color=colour, ls=dashes, label=label)
            if name.endswith(" rolling"):
                grip = float(result.scene.object.friction[parse_contact(name)[0]])
                slack = grip * course.cn[:, k] - np.abs(course.ct[:, k])
                label = label and r"its $\mu c_n - |c_t|$"
                ax.plot(course.time, slack, color=colour, ls=":", label=label)
    ax.set_ylabel("contact force $c_n$ [N]")
    ax.autoscale(axis="y")  # with what other axes hold that share this one
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, 0.0) - 0.14 * (high - min(low, 0.0)), high)
    _draw_holds(result, ax)
    _mark_margin(result, ax)
    _finish(ax, result)
    return _legend(ax, 3) if legend else ax


def _draw_holds(result: Result, ax: Axes) -> None:
    """Times at which friction holds the object at rest, shaded, with what the contacts can bear there."""
    label: str = "held: the best least force"
    for held in (held for phase in result.phases for held in phase.holds):
        ax.axvspan(held.start, held.end, color=_PALE, alpha=0.35, lw=0, zorder=0)
        if np.isfinite(held.margin):
            ax.hlines(held.margin, held.start, held.end, color=_INK, lw=1.0, ls="--", label=label)
            label = "_nolegend_"


def _mark_margin(result: Result, ax: Axes) -> None:
    """A dot at the margin, and its words below the curves."""
    worst = result.hardest
    if not np.isfinite(worst.margin):
        return
    ax.axhline(worst.margin, color=_PALE, lw=0.6, zorder=0)
    ax.plot(worst.margin_time, worst.margin, "o", color=_INK, ms=3.5, zorder=5, clip_on=False)
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
        arrowprops={"arrowstyle": "-", "color": _INK, "lw": 0.5, "shrinkA": 0, "shrinkB": 2},
    )


def draw_result(result: Result, axes=None) -> np.ndarray:
    """Torques above forces on one time axis; takes and returns two axes."""
    if axes is None:
        _, axes = plt.subplots(2, 1, figsize=(COLUMN, 3.9), sharex=True, layout="constrained", height_ratios=(2, 3))
    draw_torques(result, axes[0], legend=False).set_xlabel("")
    draw_forces(result, axes[1]).set_title("")
    _legend(axes[0], 2)
    for words in axes[1].texts:
        words.set_visible(words.get_style() != "italic")  # the phases' names stand above the torques
    return axes


def draw_history(found: Optimised, ax: Axes | None = None) -> Axes:
    """The least force [N] over the steps of the descent, a curve for each start of each phase, and the bounds."""
    ax = ax or plt.gca()
    for phase in range(len(found.bounds)):
        colour = CONTACT_COLOURS[1:][phase % (len(CONTACT_COLOURS) - 1)]
        steps = [step for step in found.history if step.phase == phase]
        if not steps:
            continue  # it is optimised together with the phase before it
        for start in sorted({step.start for step in steps}):
            curve = [(step.step, step.margin) for step in steps if step.start == start]
            label = found.result.phases[phase].name if start == steps[0].start else None
            ax.plot(*np.transpose(curve), color=colour, ls=_dashed(start % len(DASHES)), label=label)
        ax.axhline(float(found.bounds[phase].value), color=colour, lw=0.6, ls=":")
    ax.set_xlabel("step of the descent")
    ax.set_ylabel("least force [N]")
    ax.spines[["top", "right"]].set_visible(False)
    return _legend(ax, 2)


def draw_execution(execution: Execution, axes=None) -> np.ndarray:
    """An execution on top of its prediction: contact forces, deviation of the object, and which contacts touch.

    Takes and returns three axes.
    """
    if axes is None:
        ratios = (3, 1.2, 0.22 * len(execution.planned) + 0.3)
        size = (PAGE, 6.0)
        _, axes = plt.subplots(3, 1, figsize=size, sharex=True, layout="constrained", height_ratios=ratios)
    draw_execution_forces(execution, axes[0])
    draw_deviation(execution, axes[1])
    draw_touch(execution, axes[2])
    for ax in axes[:2]:
        ax.set_xlabel("")
    return np.asarray(axes)


def draw_execution_strip(execution: Execution, poses: int = 8, axes=None) -> np.ndarray:
    """An execution as a strip of poses, the predicted object dashed; takes and returns an array of axes."""
    axes = _grid(axes, 2, (poses + 1) // 2, 0.95)
    shown = np.linspace(0, len(execution.course.time) - 1, axes.size).round().astype(int)
    for ax, row in zip(axes.flat, shown, strict=True):
        _draw_moment(execution, row, ax)
    return axes


def animate(execution: Execution, frames_per_second: int = 25, ax: Axes | None = None) -> FuncAnimation:
    """An execution in real time, the predicted object dashed."""
    times = execution.course.time
    count = max(2, round(times[-1] * frames_per_second) + 1)
    shown = np.searchsorted(times, np.linspace(0, times[-1], count) - 1e-9)
    ax = ax or plt.figure(figsize=(4.8, 3.6), layout="constrained").add_subplot()
    figure = ax.get_figure(root=True)
    assert figure is not None
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
    draw_pose(execution.prediction.scene, execution.course.z[row], ax, label=f"$t$ = {time:.2f} s")
    expected = execution.expected
    if time <= expected.time[-1] + 1e-9:
        z = expected.z[min(np.searchsorted(expected.time, time - 1e-9), len(expected.time) - 1)]
        outline = _outline(execution.prediction.scene, z)
        ax.add_patch(Patch(outline, closed=True, fill=False, edgecolor=COLOURS[1], lw=0.8, ls="--", zorder=4))


def draw_execution_forces(execution: Execution, ax: Axes | None = None) -> Axes:
    """Executed contact forces [N] over time, thin, on those that were predicted, pale and wide."""
    ax = ax or plt.gca()
    expected = execution.expected
    for name in execution.planned:
        column = execution.names.index(name)
        colour = _colour(execution, name)
        predicted = np.where(expected.cn[:, column] == 0, np.nan, expected.cn[:, column])
        ax.plot(expected.time, predicted, color=colour, lw=3.5, alpha=0.35, solid_capstyle="butt")
        executed = execution.course.cn[:, column]
        ax.plot(execution.course.time, np.where(executed > 0, executed, np.nan), color=colour, lw=0.9, label=name)
    high = np.nanmax(np.where(np.isfinite(expected.cn), expected.cn, 0.0))
    ax.set_ylim(-0.03 * high, 1.35 * high)
    ax.plot([], [], color=_PALE, lw=3.5, alpha=0.6, label="predicted")
    ax.set_ylabel("contact force $c_n$ [N]")
    _finish(ax, execution.prediction)
    return _legend_beside(ax)


def draw_deviation(execution: Execution, ax: Axes | None = None) -> Axes:
    """How far the executed object is from the predicted one over time [mm]: its centre, and its angle at its rim."""
    ax = ax or plt.gca()
    course, expected = execution.course, execution.expected
    z = np.stack([np.interp(expected.time, course.time, course.z[:, k]) for k in range(3)], axis=1)
    off = z - expected.z[:, :3]
    corners = np.asarray(body(execution.prediction.scene.object).vertices)
    rim = 1e3 * np.hypot(*corners.T).max() * np.abs(off[:, 2])
    ax.plot(expected.time, 1e3 * np.hypot(off[:, 0], off[:, 1]), color=COLOURS[0], label="centre of mass")
    ax.plot(expected.time, rim, color=COLOURS[1], ls="--", label="angle, at its rim")
    _finish(ax, execution.prediction, named=False)
    ax.set_ylim(bottom=0)
    ax.set_ylabel("deviation [mm]")
    return _legend_beside(ax)


def draw_touch(execution: Execution, ax: Axes | None = None) -> Axes:
    """A pale bar while a contact is predicted to touch, and a full one within it while it does."""
    ax = ax or plt.gca()
    shown = [n for n in execution.names if n in execution.planned or _touches(execution, n)]
    for place, name in enumerate(shown):
        column = execution.names.index(name)
        colour = _colour(execution, name) if name in execution.planned else _INK
        for course, height, alpha in ((execution.expected, 0.8, 0.35), (execution.course, 0.3, 1.0)):
            for begin, end in _spans(course.time, course.touch[:, column]):
                ax.barh(place, end - begin, left=begin, height=height, color=colour, alpha=alpha, lw=0)
    _finish(ax, execution.prediction, named=False, zero=False)
    ax.set_yticks(range(len(shown)), shown)
    ax.set_ylim(len(shown) - 0.5, -0.5)
    return ax


def _touches(execution: Execution, name: str) -> bool:
    column = execution.names.index(name)
    return bool(execution.course.touch[:, column].any() or execution.expected.touch[:, column].any())


def save_figure(draw: Callable[[], Any], folder: Path, name: str) -> None:
    """Draw with the settings of a paper; write it to look at, and as vectors for the web and for print."""
    with plt.rc_context(PAPER):
        figure = np.ravel(draw())[0].figure
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once is enough for every format
        for kind, undated in (("png", {}), ("svg", {"Date": None}), ("pdf", {"CreationDate": None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=250, bbox_inches="tight", metadata=undated)
            write_whole(folder / f"{name}.{kind}", buffer.getvalue())
        plt.close(figure)


def _spans(times, flags):
    """Intervals of time in which a flag holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    last = len(times) - 1
    return [(times[begin], times[min(end, last)]) for begin, end in edges.reshape(-1, 2)]


def _colour(execution: Execution, name: str) -> str:
    """The colour of a contact of the plan."""
    styles = contact_styles(phase.contacts for phase in execution.prediction.phases)
    return CONTACT_COLOURS[styles[name][0]]


def _dashed(number: int):
    """A line style of the palette, as matplotlib writes it."""
    return (0, DASHES[number]) if DASHES[number] else "-"


def _finish(ax: Axes, result: Result, *, named: bool = True, zero: bool = True) -> None:
    """Time axis, phases and frame of a plot over time."""
    for phase in result.phases:
        ax.axvline(phase.start, color=_PALE, lw=0.6, ls=":")
        middle, over = phase.start + phase.duration / 2, ax.get_xaxis_transform()
        if named:
            ax.text(middle, 1.01, phase.name, transform=over, ha="center", va="bottom", style="italic")
    if zero:
        ax.axhline(0, color=_INK, lw=0.6)
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


def _legend_beside(ax: Axes) -> Axes:
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return ax


def draw_survey(
    told: Survey,
    influence: dict[str, float] | None = None,
    parameters: Sequence[tuple[str, np.ndarray]] = (),
    axes: Sequence[Axes] | None = None,
) -> Sequence[Axes]:
    """Margins by what became of the scenes; what the margin depends on most; its mean over two `parameters`.

    `influence` are rank correlations by name, `parameters` names and shifts of the sampled scenes in [-1, 1]; without
    them the figure is the histogram alone.
    """
    panels = 1 + bool(influence) + (len(parameters) == 2)
    size = {"figsize": (3.1 * panels, 2.9), "layout": "constrained", "squeeze": False}
    chosen = axes if axes is not None else plt.subplots(1, panels, **size)[1][0]
    _draw_margins(told, chosen[0])
    if influence:
        _draw_influence(influence, chosen[1])
    if len(parameters) == 2:
        _draw_map(told, parameters, chosen[panels - 1])
    return chosen


def _draw_margins(told: Survey, ax: Axes) -> None:
    finite = np.isfinite(told.margins)
    found = [status for status in Status if np.any(told.statuses[finite] == status)]
    groups = [told.margins[finite & (told.statuses == status)] for status in found]
    colours = [_HOLDS if status is Status.OK else _FATES[k % len(_FATES)] for k, status in enumerate(found)]
    bins = int(np.clip(np.sqrt(finite.sum()), 8, 60))
    if groups:
        names = ["holds" if status is Status.OK else status.label.replace("_", " ") for status in found]
        ax.hist(groups, bins=bins, stacked=True, color=colours, label=names)
        ax.legend(frameon=False, fontsize=7)
    if ax.get_xlim()[0] < 0:
        ax.axvline(0.0, color=_INK, lw=0.8)
    low, high = (100 * end for end in told.interval)
    ax.set_title(f"{100 * told.holds / told.count:.3g} % hold ({low:.3g} to {high:.3g} %)", fontsize=9)
    ax.set(xlabel="margin [N]", ylabel="scenes")
    ax.spines[["top", "right"]].set_visible(False)


def _draw_influence(influence: dict[str, float], ax: Axes, most: int = 8) -> None:
    shown = sorted(influence.items(), key=lambda item: -abs(item[1]))[:most]
    names, ranks = zip(*shown, strict=True)
    ax.barh(names, ranks, height=0.7, color=[COLOURS[0] if rank > 0 else COLOURS[1] for rank in ranks])
    ax.axvline(0.0, color=_INK, lw=0.8)
    ax.invert_yaxis()
    ax.tick_params(axis="y", length=0, labelsize=8)
    ax.set_title("what the margin depends on", fontsize=9)
    ax.set_xlabel("rank correlation")
    ax.spines[["top", "right", "left"]].set_visible(False)


def _draw_map(told: Survey, parameters: Sequence[tuple[str, np.ndarray]], ax: Axes) -> None:
    """The mean margin in squares that hold two dozen scenes or more."""
    (across, x), (up, y) = parameters
    finite = np.isfinite(told.margins)
    edges = np.linspace(-1.0, 1.0, int(np.clip(np.sqrt(finite.sum() / 24), 2, 40)) + 1)
    number, *_ = np.histogram2d(y[finite], x[finite], bins=(edges, edges))
    total, *_ = np.histogram2d(y[finite], x[finite], bins=(edges, edges), weights=told.margins[finite])
    mean = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    image = ax.pcolormesh(edges, edges, mean, cmap="cividis", rasterized=True)
    ax.set(xlabel=f"{across}, share of its range", ylabel=f"{up}, share of its range", aspect="equal")
    ax.set_title("mean margin [N]", fontsize=9)
    plt.colorbar(image, ax=ax)
