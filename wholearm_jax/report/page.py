"""Reports: a result folder as one HTML page that needs nothing else: animation with forces, plots, strip and tables.

A page is made from the files that `files.results` writes, and so at any time later.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from jinja2 import Environment, PackageLoader

from wholearm_jax.core import Status
from wholearm_jax.plotting.palette import CONTACT_COLOURS, DARK_CONTACT_COLOURS, DARK_LINK_COLOURS, LINK_COLOURS
from wholearm_jax.report.page_data import page_data, split_columns
from wholearm_jax.report.result_folder import ResultFolder, critical_phase, load_result_folder

DASH = "\N{EN DASH}"  # for undefined numbers
SETTING_NAMES = {
    "seconds": "time taken [s]",
    "steps": "steps of descent",
    "rate_limit": "largest torque rate [N m/s]",
    "passing": "least speed at changes, over the mean",
    "hold_margin": "margin of the holds [N]",
    "varied": "varied scenes",
    "arrival": "arrived within, of the path's length",
    "unseen_share": "share that holds of unseen scenes",
    "unseen_margin": "worst margin [N] of unseen scenes",
    "unseen_share_nominal": "share that holds of unseen scenes, nominal schedule",
    "unseen_margin_nominal": "worst margin [N] of unseen scenes, nominal schedule",
}


def report(folder: str | Path) -> str:
    """Return the report of a result folder as one HTML page.

    Reads `summary.json`, `trajectory.csv`, `torque.csv` and, if there is one, `controller.json`. Raises `SceneError`
    naming the file and what is wrong.
    """
    return render(load_result_folder(folder))


def render(result: ResultFolder) -> str:
    """Return the report of a result as one HTML page."""
    pages = Environment(loader=PackageLoader("wholearm_jax.report", "templates"), autoescape=True, trim_blocks=True)
    pages.filters |= {"digits": _digits}
    summary = result.summary
    return pages.get_template("report.html").render(
        summary=summary,
        advice=Status[summary["status"].upper()].advice,
        critical=critical_phase(summary),
        rows=[row | {"reached": _bound_fraction(row)} for row in summary["phases"]],
        poses=_poses(result),
        law=result.controller,
        endings=[_ending(phase) for phase in result.controller["phases"]] if result.controller else [],
        settings=_settings(summary),
        scene_toml=tomli_w.dumps(summary["scene"]),
        colours={
            "light": _css_variables(LINK_COLOURS, CONTACT_COLOURS),
            "dark": _css_variables(DARK_LINK_COLOURS, DARK_CONTACT_COLOURS),
        },
        moves=bool(result.trajectories),
        rolls=any(name.endswith(" rolling") for row in summary["phases"] for name in row["contacts"]),
        data=page_data(result),
    )


def _bound_fraction(row: dict[str, Any]) -> str:
    """Return the fraction of its bound that a phase reached; a dash for one that fails, maybe before its hard part."""
    bound, margin = row["bound"], row["margin"]
    if row["status"] != Status.OK.label or not bound or margin is None:
        return DASH
    return f"{100 * margin / bound:.1f} %" if margin > 0 and bound > 0 else DASH


def _ending(phase: dict[str, Any]) -> str:
    """Say how a law ends a phase."""
    if phase["flows"]:
        return "at the path's end, in motion"
    if phase["reach"] == 0:
        return "by the clock, at rest"
    pressed = phase["press"] * np.abs(phase["gain"][-1])
    torques = " and ".join(f"{torque:.2g}" for torque in pressed)
    return f"pressed against the new contact, by up to {torques} N m"


def _poses(result: ResultFolder) -> list[dict[str, str]]:
    """Return where each phase that moves begins and ends, its displacement and its turn: in millimetres and degrees."""
    poses = []
    for name, rows in result.trajectories.items():
        z = split_columns(rows)["z"]
        begin, end = z[0], z[-1]
        pose = {"name": name, "begin": _millimetres(begin[:2]), "end": _millimetres(end[:2])}
        pose |= {"begin_angle": _degrees(begin[2]), "end_angle": _degrees(end[2])}
        poses.append(pose | {"displacement": _millimetres((end - begin)[:2]), "turn": _degrees(end[2] - begin[2])})
    return poses


def _millimetres(position) -> str:
    return ", ".join(f"{round(1e3 * float(x), 1) + 0.0:.1f}" for x in position)


def _degrees(angle: float) -> str:
    return f"{round(math.degrees(angle), 1) + 0.0:.1f}"


def _settings(summary: dict[str, Any]) -> dict[str, str]:
    """Return how the result was made: the entries of the summary other than the result itself."""
    others = {"status", "margin", "message", "phases", "scene", "stopped", "gradient"}
    return {SETTING_NAMES.get(k, k): _digits(v) for k, v in summary.items() if k not in others and v is not None}


def _css_variables(links, contacts) -> dict[str, str]:
    """Return the CSS variables of a palette."""
    fingers = {f"finger{k + 1}": colour for k, colour in enumerate(links)}
    return fingers | {f"contact{k}": colour for k, colour in enumerate(contacts)}


def _digits(value, count: int = 4) -> str:
    """Return a number with `count` significant digits; a dash for None."""
    if value is None:
        return DASH
    return f"{value:.{count}g}" if isinstance(value, float) else str(value)
