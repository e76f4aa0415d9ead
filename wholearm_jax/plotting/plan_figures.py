"""Figures of one plan over time: torques, contact forces, and how the optimisation went.

Every function of `plotting` draws on the axes that it is given, or on new ones, and returns them, so that figures are
composed as with matplotlib alone. Sizes of text and lines come from matplotlib's settings; `PAPER` has those of the
field's papers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from wholearm_jax.model import parse_contact
from wholearm_jax.phases import Result, trajectory
from wholearm_jax.plotting.palette import CONTACT_COLOURS, DASHES, contact_styles
from wholearm_jax.plotting.palette import LINK_COLOURS as COLOURS
from wholearm_jax.plotting.style import COLUMN, INK, PALE, add_legend_below, dash_style, format_time_axis

if TYPE_CHECKING:  # figures do not need the optimiser to be loaded
    from wholearm_jax.optimisation import OptimisationResult


def plot_torques(result: Result, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Joint torques [N m] over time [s] (as the paper's fig. 6), and their limits, dotted."""
    ax = ax or plt.gca()
    times, values = np.asarray(result.torque.times), np.asarray(result.torque.values)
    for k in range(2):
        ax.plot(times, values[:, k], color=COLOURS[k], ls=dash_style(k), label=f"finger {k + 1}")
        limit = float(result.scene.hand.torque_limit[k])
        for sign in (1, -1):
            ax.axhline(sign * limit, color=COLOURS[k], lw=0.6, ls=":")
    ax.set_ylabel(r"torque $\tau$ [N m]")
    format_time_axis(ax, result)
    return add_legend_below(ax, 2) if legend else ax


def plot_forces(result: Result, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Normal contact forces [N] over time [s], with the margin and its time marked.

    Dotted, for rolling contacts: `mu c_n - |c_t|`, the distance of the force from its friction cone.
    """
    ax = ax or plt.gca()
    styles, labelled = contact_styles(phase.contacts for phase in result.phases), set()
    for phase, motion in zip(result.phases, trajectory(result, 801), strict=False):
        for k, name in enumerate(phase.contacts):
            colour, dashes = CONTACT_COLOURS[styles[name][0]], dash_style(styles[name][1])
            label = None if name in labelled else name
            labelled.add(name)
            ax.plot(motion.time, motion.cn[:, k], color=colour, ls=dashes, label=label)
            if name.endswith(" rolling"):
                friction = float(result.scene.object.friction[parse_contact(name)[0]])
                slack = friction * motion.cn[:, k] - np.abs(motion.ct[:, k])
                label = label and r"its $\mu c_n - |c_t|$"
                ax.plot(motion.time, slack, color=colour, ls=":", label=label)
    ax.set_ylabel("contact force $c_n$ [N]")
    _shade_rests(result, ax)
    ax.autoscale(axis="y")  # with what other axes hold that share this one
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, 0.0) - 0.14 * (high - min(low, 0.0)), high)
    _mark_margin(result, ax)
    format_time_axis(ax, result)
    return add_legend_below(ax, 3) if legend else ax


def _shade_rests(result: Result, ax: Axes) -> None:
    """Shade the times at which friction holds the object at rest, with the margin of each rest."""
    label: str = "held at rest"
    for rest in (rest for phase in result.phases for rest in phase.holds):
        ax.axvspan(rest.start, rest.end, color=PALE, alpha=0.35, lw=0, zorder=0)
        if np.isfinite(rest.margin):
            ax.hlines(rest.margin, rest.start, rest.end, color=INK, lw=1.0, ls="--", label=label)
            label = "_nolegend_"


def _mark_margin(result: Result, ax: Axes) -> None:
    """Mark the margin by a dot, and describe it below the curves."""
    critical = result.critical_phase
    if not np.isfinite(critical.margin):
        return
    ax.axhline(critical.margin, color=PALE, lw=0.6, zorder=0)
    ax.plot(critical.margin_time, critical.margin, "o", color=INK, ms=3.5, zorder=5, clip_on=False)
    is_late = critical.margin_time > 0.5 * float(result.torque.times[-1])
    words = f"margin {critical.margin:.3g} N, {critical.margin_contact}, $t$ = {critical.margin_time:.3g} s"
    ax.annotate(
        words,
        (critical.margin_time, critical.margin),
        xytext=(0.97 if is_late else 0.03, 0.02),
        textcoords="axes fraction",
        ha="right" if is_late else "left",
        va="bottom",
        fontsize="small",
        arrowprops={"arrowstyle": "-", "color": INK, "lw": 0.5, "shrinkA": 0, "shrinkB": 2},
    )


def plot_result(result: Result, axes=None) -> np.ndarray:
    """Joint torques above contact forces on one time axis; takes and returns two axes."""
    if axes is None:
        _, axes = plt.subplots(2, 1, figsize=(COLUMN, 4.7), sharex=True, layout="constrained", height_ratios=(2, 3))
    plot_torques(result, axes[0], legend=False).set_xlabel("")
    plot_forces(result, axes[1]).set_title("")
    add_legend_below(axes[0], 2)
    for text in axes[1].texts:
        text.set_visible(text.get_style() != "italic")  # the phases' names stand above the torques
    return axes


def plot_history(optimum: OptimisationResult, ax: Axes | None = None) -> Axes:
    """The smallest force [N] over the solver's iterations, a curve for each start of each phase, and the bounds."""
    ax = ax or plt.gca()
    for phase in range(len(optimum.bounds)):
        colour = CONTACT_COLOURS[1:][phase % (len(CONTACT_COLOURS) - 1)]
        steps = [step for step in optimum.history if step.phase == phase]
        if not steps:
            continue  # it is optimised together with the phase before it
        for start in sorted({step.start for step in steps}):
            curve = [(step.iteration, step.margin) for step in steps if step.start == start]
            label = optimum.result.phases[phase].name if start == steps[0].start else None
            ax.plot(*np.transpose(curve), color=colour, ls=dash_style(start % len(DASHES)), label=label)
        ax.axhline(float(optimum.bounds[phase].value), color=colour, lw=0.6, ls=":")
    ax.set_xlabel("iteration")
    ax.set_ylabel("smallest force [N]")
    ax.spines[["top", "right"]].set_visible(False)
    return add_legend_below(ax, 2)
