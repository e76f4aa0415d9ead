"""Figures of ensembles: the results of many scenes, and which parameters their margins depend on."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from wholearm_jax.core import Status
from wholearm_jax.ensembles import EnsembleSummary
from wholearm_jax.plotting.palette import LINK_COLOURS as COLOURS
from wholearm_jax.plotting.style import INK

_OK_COLOUR, _STATUS_COLOURS = "#009E73", ("#D55E00", "#E69F00", "#56B4E9", "#CC79A7", "#8B6914", "#999999")


def plot_ensemble(
    summary: EnsembleSummary,
    influence: dict[str, float] | None = None,
    parameters: Sequence[tuple[str, np.ndarray]] = (),
    axes: Sequence[Axes] | np.ndarray | None = None,
) -> Sequence[Axes] | np.ndarray:
    """Plot margins by status, the parameters that they depend on most, and the mean margin over two `parameters`.

    Args:
        summary: of the ensemble.
        influence: rank correlation of the margin with each parameter, by name; None: no such panel.
        parameters: two names, each with its offsets `(scenes,)` in [-1, 1]; empty: no such panel.
        axes: one for each panel; None: new ones.
    """
    panels = 1 + bool(influence) + (len(parameters) == 2)
    size = {"figsize": (3.1 * panels, 2.9), "layout": "constrained", "squeeze": False}
    panels_axes = axes if axes is not None else plt.subplots(1, panels, **size)[1][0]
    _plot_margins(summary, panels_axes[0])
    if influence:
        _plot_influence(influence, panels_axes[1])
    if len(parameters) == 2:
        _plot_map(summary, parameters, panels_axes[panels - 1])
    return panels_axes


def _plot_margins(summary: EnsembleSummary, ax: Axes) -> None:
    finite = np.isfinite(summary.margins)
    statuses = [status for status in Status if np.any(summary.statuses[finite] == status)]
    groups = [summary.margins[finite & (summary.statuses == status)] for status in statuses]
    failed = [_STATUS_COLOURS[k % len(_STATUS_COLOURS)] for k in range(len(statuses))]
    colours = [_OK_COLOUR if s is Status.OK else colour for s, colour in zip(statuses, failed, strict=True)]
    bins = int(np.clip(np.sqrt(finite.sum()), 8, 60))
    if groups:
        names = ["holds" if status is Status.OK else status.label.replace("_", " ") for status in statuses]
        ax.hist(groups, bins=bins, stacked=True, color=colours, label=names)
        ax.legend(frameon=False, fontsize=7)
    if ax.get_xlim()[0] < 0:
        ax.axvline(0.0, color=INK, lw=0.8)
    low, high = (100 * end for end in summary.interval)
    ax.set_title(f"{100 * summary.holds / summary.count:.3g} % hold ({low:.3g} to {high:.3g} %)", fontsize=9)
    ax.set(xlabel="margin [N]", ylabel="scenes")
    ax.spines[["top", "right"]].set_visible(False)


def _plot_influence(influence: dict[str, float], ax: Axes, most: int = 8) -> None:
    shown = sorted(influence.items(), key=lambda item: -abs(item[1]))[:most]
    names, ranks = zip(*shown, strict=True)
    ax.barh(names, ranks, height=0.7, color=[COLOURS[0] if rank > 0 else COLOURS[1] for rank in ranks])
    ax.axvline(0.0, color=INK, lw=0.8)
    ax.invert_yaxis()
    ax.tick_params(axis="y", length=0, labelsize=8)
    ax.set_title("what the margin depends on", fontsize=9)
    ax.set_xlabel("rank correlation")
    ax.spines[["top", "right", "left"]].set_visible(False)


def _plot_map(summary: EnsembleSummary, parameters: Sequence[tuple[str, np.ndarray]], ax: Axes) -> None:
    """Plot the mean margin in squares: two dozen scenes in each on average, at most 40 squares a side."""
    (across, x), (up, y) = parameters
    finite = np.isfinite(summary.margins)
    edges = np.linspace(-1.0, 1.0, int(np.clip(np.sqrt(finite.sum() / 24), 2, 40)) + 1)
    number, *_ = np.histogram2d(y[finite], x[finite], bins=(edges, edges))
    total, *_ = np.histogram2d(y[finite], x[finite], bins=(edges, edges), weights=summary.margins[finite])
    mean = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    image = ax.pcolormesh(edges, edges, mean, cmap="cividis", rasterized=True)
    ax.set(xlabel=f"{across}, share of its range", ylabel=f"{up}, share of its range", aspect="equal")
    ax.set_title("mean margin [N]", fontsize=9)
    plt.colorbar(image, ax=ax)
