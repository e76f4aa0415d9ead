"""Figures with matplotlib."""

import importlib

_MODULES = {
    "COLUMN": "plan_figures",
    "LINK_COLOURS": "palette",
    "PAGE": "plan_figures",
    "PAPER": "plan_figures",
    "animate": "execution_figures",
    "draw_ensemble": "ensemble_figures",
    "draw_execution": "execution_figures",
    "draw_execution_strip": "execution_figures",
    "draw_forces": "plan_figures",
    "draw_history": "plan_figures",
    "draw_pose": "plan_figures",
    "draw_result": "plan_figures",
    "draw_strip": "plan_figures",
    "draw_successors": "plan_figures",
    "draw_torques": "plan_figures",
    "save_figure": "plan_figures",
}

__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    """Import a figure's module, and matplotlib with it, when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
