"""Draw maps of disturbances: which executions succeed, over the size of what was wrong and over when or where."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from wholearm_jax.plotting.palette import LINK_COLOURS as COLOURS
from wholearm_jax.plotting.style import INK

if TYPE_CHECKING:  # running executions needs MuJoCo, drawing them does not
    from wholearm_jax.execution import DisturbanceMap


def plot_disturbance_map(found: DisturbanceMap, ax: Axes | None = None) -> Axes:
    """Draw one cell an execution: full where it succeeds, a cross where it fails."""
    ax = plt.gca() if ax is None else ax
    columns, rows = np.meshgrid(np.arange(len(found.columns)), np.arange(len(found.sizes)))
    good = found.succeeds
    ax.scatter(columns[good], rows[good], s=120, marker="s", color=COLOURS[0], label="succeeds")
    ax.scatter(columns[~good], rows[~good], s=30, marker="x", color=COLOURS[1], label="fails")
    ax.set_xticks(range(len(found.columns)), [c if isinstance(c, str) else f"{c:.3g}" for c in found.columns])
    ax.set_yticks(range(len(found.sizes)), [f"{size:.3g}" for size in found.sizes])
    ax.set_xlim(-0.6, len(found.columns) - 0.4)
    ax.set_ylim(-0.6, len(found.sizes) - 0.4)
    ax.set_ylabel(found.kind)
    if not isinstance(found.columns[0], str):
        ax.set_xlabel("begins at [s]")
    ax.set_facecolor("0.95")
    ax.tick_params(colors=INK, length=0)
    ax.spines[:].set_visible(False)
    return ax
