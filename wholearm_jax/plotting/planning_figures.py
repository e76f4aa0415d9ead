"""Figure of a search for plans."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from wholearm_jax.planning import PlanningResult
from wholearm_jax.plotting.palette import LINK_COLOURS
from wholearm_jax.plotting.style import COLUMN, FILL, INK, PALE


def plot_search(found: PlanningResult, ax: Axes | None = None) -> Axes:
    """Plot what a search reached, as positions `x` and angles `phi` of the object, with the best plan and the goal.

    Args:
        found: the result of `plan`.
        ax: axes to draw on; None: new ones.
    """
    if ax is None:
        ax = plt.subplots(figsize=(COLUMN, 0.8 * COLUMN), layout="constrained")[1]
    moves = [[_place(edge.begin), _place(edge.end)] for edge in found.graph]
    ax.add_collection(LineCollection(moves, colors=PALE, linewidths=0.5))
    _plot_goal(found, ax)
    shown = found.plans[0] if found.found else found.nearest
    if shown is not None:
        steps = np.array([_place(shown.begins[0]), *(_place(end) for end in shown.ends)])
        label = f"best plan, bound {shown.bound:.3g} N" if found.found else "to the nearest pose"
        ax.plot(*steps.T, "o-", color=LINK_COLOURS[0], ms=3, label=label)
    ax.plot(*_place(found.start), "s", color=INK, ms=4, label="start")
    ax.set(xlabel="$x$ [mm]", ylabel=r"$\varphi$ [deg]", title=f"{found.nodes} poses expanded, {found.moves} paths")
    ax.autoscale_view()
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)  # data may be anywhere
    return ax


def _place(z) -> tuple[float, float]:
    return 1e3 * float(z[0]), float(np.degrees(z[2]))


def _plot_goal(found: PlanningResult, ax: Axes) -> None:
    """Shade the goal's values of `x` and `phi`, within their tolerances."""
    spans = {"x": (ax.axvspan, 1e3), "phi": (ax.axhspan, 180 / np.pi)}
    for name, (span, unit) in spans.items():
        if name in found.goal.values:
            value, tolerance = found.goal.values[name], found.goal.tolerance[name]
            span(unit * (value - tolerance), unit * (value + tolerance), color=FILL, lw=0.5, ec=INK)
