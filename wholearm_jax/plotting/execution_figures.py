"""Figures of executions: contact forces, deviation and contacts over time, poses, and an animation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.patches import Polygon as Patch

from wholearm_jax.model import feature_pair, rigid_body
from wholearm_jax.plotting.palette import CONTACT_COLOURS, contact_styles
from wholearm_jax.plotting.palette import LINK_COLOURS as COLOURS
from wholearm_jax.plotting.pose_figures import object_outline, plot_pose, pose_grid
from wholearm_jax.plotting.style import INK, PAGE, PALE, format_time_axis

SOFT = 2e-3  # depth of soft contacts that is not marked as an overlap [object radii; rad]

if TYPE_CHECKING:  # running it needs MuJoCo, drawing does not
    from wholearm_jax.execution import Execution


def plot_execution(execution: Execution, axes=None) -> np.ndarray:
    """Plot an execution over its prediction: contact forces, deviation of the object, and which contacts touch.

    Takes and returns three axes.
    """
    if axes is None:
        ratios = (3, 1.2, 0.22 * len(execution.planned) + 0.3)
        size = (PAGE, 6.0)
        _, axes = plt.subplots(3, 1, figsize=size, sharex=True, layout="constrained", height_ratios=ratios)
    plot_execution_forces(execution, axes[0])
    plot_deviation(execution, axes[1])
    plot_touching(execution, axes[2])
    for ax in axes[:2]:
        ax.set_xlabel("")
    return np.asarray(axes)


def plot_execution_strip(execution: Execution, poses: int = 8, axes=None) -> np.ndarray:
    """Plot an execution as a strip of poses, the predicted object dashed; takes and returns an array of axes."""
    axes = pose_grid(axes, 2, (poses + 1) // 2, 0.95)
    shown = np.linspace(0, len(execution.course.time) - 1, axes.size).round().astype(int)
    for ax, row in zip(axes.flat, shown, strict=True):
        _plot_step(execution, int(row), ax)
    return axes


def animate(execution: Execution, frames_per_second: int = 25, ax: Axes | None = None) -> FuncAnimation:
    """Animate an execution in real time, the predicted object dashed."""
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
        _plot_step(execution, int(row), ax)
        ax.set_xlim(-across, across)
        ax.set_ylim(-0.1 * reach, 1.2 * reach)
        return ()

    return FuncAnimation(figure, show, frames=shown, interval=1000 / frames_per_second)


def _plot_step(execution: Execution, row: int, ax: Axes) -> None:
    """Plot the executed pose of time step `row`, and the predicted object's outline."""
    time = execution.course.time[row]
    scene, z = execution.prediction.scene, execution.course.z[row]
    plot_pose(scene, z, ax, label=f"$t$ = {time:.2f} s", tolerance=SOFT)
    expected = execution.expected
    if time <= expected.time[-1] + 1e-9:
        z = np.stack([np.interp(time, expected.time, expected.z[:, k]) for k in range(5)])
        outline = object_outline(scene, z)
        ax.add_patch(Patch(outline, closed=True, fill=False, edgecolor=COLOURS[1], lw=0.8, ls="--", zorder=4))


def plot_execution_forces(execution: Execution, ax: Axes | None = None) -> Axes:
    """Plot executed contact forces [N] over time, thin, on predicted ones, pale and wide."""
    ax = ax or plt.gca()
    expected = execution.expected
    for name in execution.planned:
        column = execution.names.index(name)
        colour = _colour(execution, name)
        predicted = np.where(expected.cn[:, column] == 0, np.nan, expected.cn[:, column])
        ax.plot(expected.time, predicted, color=colour, lw=3.5, alpha=0.35, solid_capstyle="butt")
        executed = execution.course.cn[:, column]
        ax.plot(execution.course.time, np.where(executed > 0, executed, np.nan), color=colour, lw=0.9, label=name)
    # The range is that of the predicted forces, because impact peaks would hide them; of the executed without any.
    high = np.nanmax(np.where(np.isfinite(expected.cn), expected.cn, 0.0)) or execution.course.cn.max() or 1.0
    ax.set_ylim(-0.03 * high, 1.35 * high)
    ax.plot([], [], color=PALE, lw=3.5, alpha=0.6, label="predicted")
    ax.set_ylabel("contact force $c_n$ [N]")
    _format_time(ax, execution)
    return _legend_beside(ax)


def plot_deviation(execution: Execution, ax: Axes | None = None) -> Axes:
    """Plot the executed object's deviation from the prediction [mm]: of its centre, and angle times radius."""
    ax = ax or plt.gca()
    course, expected = execution.course, execution.expected
    z = np.stack([np.interp(expected.time, course.time, course.z[:, k]) for k in range(3)], axis=1)
    off = z - expected.z[:, :3]
    corners = np.asarray(rigid_body(execution.prediction.scene.object).vertices)
    rim = 1e3 * np.hypot(*corners.T).max() * np.abs(off[:, 2])
    ax.plot(expected.time, 1e3 * np.hypot(off[:, 0], off[:, 1]), color=COLOURS[0], label="centre of mass")
    ax.plot(expected.time, rim, color=COLOURS[1], ls="--", label="angle, at its rim")
    _format_time(ax, execution, named=False)
    ax.set_ylim(bottom=0)
    ax.set_ylabel("deviation [mm]")
    return _legend_beside(ax)


def plot_touching(execution: Execution, ax: Axes | None = None) -> Axes:
    """Plot a pale bar while a contact is predicted to touch, and a dark one inside it while it does."""
    ax = ax or plt.gca()
    shown = [n for n in execution.names if n in execution.planned or _touches(execution, n)]
    for place, name in enumerate(shown):
        column = execution.names.index(name)
        colour = _colour(execution, name) if name in execution.planned else INK
        for course, height, alpha in ((execution.expected, 0.8, 0.35), (execution.course, 0.3, 1.0)):
            for begin, end in _spans(course.time, course.touch[:, column]):
                ax.barh(place, end - begin, left=begin, height=height, color=colour, alpha=alpha, lw=0)
    _format_time(ax, execution, named=False, zero=False)
    ax.set_yticks(range(len(shown)), shown)
    ax.set_ylim(len(shown) - 0.5, -0.5)
    return ax


def _format_time(ax: Axes, execution: Execution, **options: bool) -> None:
    """Format the axis of time of an execution, whose phases a law may have begun later than planned."""
    end = max(float(execution.course.time[-1]), float(execution.expected.time[-1]))
    format_time_axis(ax, execution.prediction, begins=execution.begins, end=end, **options)


def _touches(execution: Execution, name: str) -> bool:
    column = execution.names.index(name)
    return bool(execution.course.touch[:, column].any() or execution.expected.touch[:, column].any())


def _spans(times, flags):
    """Return the intervals of time in which a flag is set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    last = len(times) - 1
    return [(times[begin], times[min(end, last)]) for begin, end in edges.reshape(-1, 2)]


def _colour(execution: Execution, name: str) -> str:
    """Return the colour of a contact of the plan."""
    styles = contact_styles(map(feature_pair, phase.contacts) for phase in execution.prediction.phases)
    return CONTACT_COLOURS[styles[name][0]]


def _legend_beside(ax: Axes) -> Axes:
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return ax
