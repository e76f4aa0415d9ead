"""Figures of surveys: what became of many scenes, and what their margins depend on.

Functions take and return axes as those of `drawing` do.
"""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from wholearm_jax.core import Status
from wholearm_jax.ensembles import EnsembleSummary
from wholearm_jax.plotting.palette import LINK_COLOURS as COLOURS
from wholearm_jax.plotting.plan_figures import INK

_HOLDS, _FATES = "#009E73", ("#D55E00", "#E69F00", "#56B4E9", "#CC79A7", "#8B6914", "#999999")  # of scenes in a survey


def plot_ensemble(
    told: EnsembleSummary,
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


def _draw_margins(told: EnsembleSummary, ax: Axes) -> None:
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
        ax.axvline(0.0, color=INK, lw=0.8)
    low, high = (100 * end for end in told.interval)
    ax.set_title(f"{100 * told.holds / told.count:.3g} % hold ({low:.3g} to {high:.3g} %)", fontsize=9)
    ax.set(xlabel="margin [N]", ylabel="scenes")
    ax.spines[["top", "right"]].set_visible(False)


def _draw_influence(influence: dict[str, float], ax: Axes, most: int = 8) -> None:
    shown = sorted(influence.items(), key=lambda item: -abs(item[1]))[:most]
    names, ranks = zip(*shown, strict=True)
    ax.barh(names, ranks, height=0.7, color=[COLOURS[0] if rank > 0 else COLOURS[1] for rank in ranks])
    ax.axvline(0.0, color=INK, lw=0.8)
    ax.invert_yaxis()
    ax.tick_params(axis="y", length=0, labelsize=8)
    ax.set_title("what the margin depends on", fontsize=9)
    ax.set_xlabel("rank correlation")
    ax.spines[["top", "right", "left"]].set_visible(False)


def _draw_map(told: EnsembleSummary, parameters: Sequence[tuple[str, np.ndarray]], ax: Axes) -> None:
    """The mean margin in squares of two dozen scenes on average, but no more than 40 a side."""
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
