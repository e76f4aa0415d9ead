"""Style of all figures: the settings and sizes of a paper, the axis of time, legends, and how figures are saved."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from wholearm_jax.core import write_atomically
from wholearm_jax.phases import Result
from wholearm_jax.plotting.palette import DASHES

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

INK, FILL, PALE = "#222222", "#E8EEF4", "#999999"
ALARM = "#CC0000"  # what cannot be
AXES_SHARE = 0.8  # width of an axis over the figure's, about
LETTER_SHARE = 0.5  # width of a letter over its size, about


def save_figure(draw: Callable[[], Any], folder: Path, name: str) -> None:
    """Save the figure that `draw` returns axes of, in the style of a paper: `NAME.png`, `NAME.svg` and `NAME.pdf`."""
    with plt.rc_context(PAPER):
        figure = np.ravel(draw())[0].figure
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once is enough for every format
        for kind, undated in (("png", {}), ("svg", {"Date": None}), ("pdf", {"CreationDate": None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=250, bbox_inches="tight", metadata=undated)
            write_atomically(folder / f"{name}.{kind}", buffer.getvalue())
        plt.close(figure)


def dash_style(number: int):
    """Return the palette's line style `number`, as matplotlib writes it."""
    return (0, DASHES[number]) if DASHES[number] else "-"


def format_time_axis(
    ax: Axes,
    result: Result,
    *,
    named: bool = True,
    zero: bool = True,
    begins: Sequence[float] | None = None,
    end: float | None = None,
) -> None:
    """Format an axis of time: its label, the phases, and its frame.

    An execution may begin phases at other times than planned, at `begins`, or only some, and `end` later [s].
    """
    begins = [phase.start for phase in result.phases] if begins is None else begins
    end = result.phases[-1].start + result.phases[-1].duration if end is None else end
    for begin, until, label in zip(begins, [*begins[1:], end], _phase_labels(ax, result), strict=False):
        ax.axvline(begin, color=PALE, lw=0.6, ls=":")
        middle, transform = (begin + until) / 2, ax.get_xaxis_transform()
        if named:
            ax.text(middle, 1.01, label, transform=transform, ha="center", va="bottom", style="italic")
    if zero:
        ax.axhline(0, color=INK, lw=0.6)
    ax.set_xlim(0, end)
    ax.set_xlabel("time $t$ [s]")
    ax.spines[["top", "right"]].set_visible(False)


def whole_figure(ax: Axes) -> Figure:
    """Return the figure that an axis is part of."""
    return cast(Figure, ax.get_figure(root=True))


def _phase_labels(ax: Axes, result: Result) -> list[str]:
    """Return the phases' names, or their numbers where a name is wider than its phase."""
    whole = sum(phase.duration for phase in result.phases)
    letters = 72 * whole_figure(ax).get_figwidth() * AXES_SHARE / (LETTER_SHARE * plt.rcParams["font.size"])
    fit = all(len(phase.name) <= letters * phase.duration / whole for phase in result.phases)
    return [phase.name if fit else str(k) for k, phase in enumerate(result.phases, 1)]


def add_legend_below(ax: Axes, columns: int) -> Axes:
    """Add a legend below an axis and its labels, where it hides nothing."""
    points = 25 if ax.get_xlabel() else 5
    below = ax.transAxes + ScaledTranslation(0, -points / 72, ax.figure.dpi_scale_trans)
    placement = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "bbox_transform": below}
    ax.legend(frameon=False, ncols=columns, columnspacing=1.2, handlelength=2.4, **placement)
    return ax
