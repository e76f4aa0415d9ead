"""Figure of margin against duration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from wholearm_jax.model import Scene
from wholearm_jax.plotting.palette import LINK_COLOURS
from wholearm_jax.plotting.style import COLUMN, INK, dash_style

if TYPE_CHECKING:  # figures do not need the optimiser to be loaded
    from wholearm_jax.optimisation import Tradeoff


def plot_tradeoff(curve: Tradeoff, scene: Scene, ax: Axes | None = None) -> Axes:
    """Plot the largest margin against the duration of each moving phase, and of all together.

    Args:
        curve: shortest durations for many margins.
        scene: the plan, for its phases' names.
        ax: axes to draw on; None: new ones.
    """
    if ax is None:
        ax = plt.subplots(figsize=(COLUMN, 0.7 * COLUMN), layout="constrained")[1]
    for column, number in enumerate(curve.phases):
        colour, dash = LINK_COLOURS[column % len(LINK_COLOURS)], dash_style(column % 4)
        ax.plot(curve.durations[:, column], curve.margins, color=colour, ls=dash, label=scene.phases[number].name)
    if len(curve.phases) > 1:
        ax.plot(curve.total, curve.margins, color=INK, lw=1.6, label="the plan")
    ax.set(xlabel="shortest duration [s]", ylabel="margin [N]")
    ax.set_xlim(0, None)
    ax.set_ylim(0, None)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False)
    return ax
