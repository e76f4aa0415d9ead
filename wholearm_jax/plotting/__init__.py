"""Figures with matplotlib."""

import importlib

_MODULES = {
    "COLUMN": "style",
    "LINK_COLOURS": "palette",
    "PAGE": "style",
    "PAPER": "style",
    "animate": "execution_figures",
    "plot_disturbance_map": "disturbance_figures",
    "plot_ensemble": "ensemble_figures",
    "plot_execution": "execution_figures",
    "plot_execution_strip": "execution_figures",
    "plot_forces": "plan_figures",
    "plot_history": "plan_figures",
    "plot_plan_poses": "pose_figures",
    "plot_pose": "pose_figures",
    "plot_result": "plan_figures",
    "plot_search": "planning_figures",
    "plot_strip": "pose_figures",
    "plot_successors": "pose_figures",
    "plot_torques": "plan_figures",
    "plot_tradeoff": "tradeoff_figures",
    "save_figure": "style",
}

__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    """Import a figure's module, and matplotlib with it, when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
