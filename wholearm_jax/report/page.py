"""Reports: a result folder as one HTML page that needs nothing else: strip, animation with forces, plots, tables.

What the page shows is read from the files that `result_file` writes, so that a report can be made at any time later.
Only the places and normals of the contacts, along which forces are drawn, are computed again (`contact_set`).
"""

from __future__ import annotations

import csv
import itertools
import json
import math
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tomli_w
from jinja2 import Environment, PackageLoader
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from wholearm_jax.core import SceneError, Status
from wholearm_jax.files import TRAJECTORY_COLUMNS, Positive, explain_validation_error, parse, read_torque
from wholearm_jax.model import (
    COORDINATES,
    Scene,
    TorqueSchedule,
    contact_kinematics,
    contact_set,
    parse_contact,
    rigid_body,
)
from wholearm_jax.plotting.palette import (
    CONTACT_COLOURS,
    DARK_CONTACT_COLOURS,
    DARK_LINK_COLOURS,
    DASHES,
    LINK_COLOURS,
    contact_styles,
)

DASH = "\N{EN DASH}"  # for what is undefined


def _label(status: str) -> str:
    if status.upper() not in Status.__members__:
        raise ValueError(f"'{status:.40}' is unknown")
    return status


Label = Annotated[str, AfterValidator(_label)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)] | None


class _PhaseRow(BaseModel):
    """What a page needs of a phase's row in a summary, which may hold more."""

    name: str
    contacts: list[str]
    status: Label
    duration: Positive
    margin: Number
    margin_time: Number
    margin_contact: str | None
    bound: Number


class _Summary(BaseModel):
    """What it needs of the whole."""

    status: Label
    margin: Number
    message: str
    phases: list[_PhaseRow]
    scene: dict[str, Any]


class ResultFolder(NamedTuple):
    """A result as its folder holds it: the summary, its scene, the schedule, and `name -> rows (time, numbers)`."""

    summary: dict[str, Any]
    scene: Scene
    torque: TorqueSchedule
    courses: dict[str, np.ndarray]


def report(folder: str | Path) -> str:
    """The report of a result folder as one HTML page.

    Reads `summary.json`, `trajectory.csv` and `torque.csv`. Raises `SceneError` naming the file and what is
    wrong.
    """
    return render(load_result_folder(folder))


def load_result_folder(folder: str | Path) -> ResultFolder:
    """Read a result folder. Raises `SceneError` naming the file and what is wrong with it."""
    folder = Path(folder)
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder")
    content = _read_summary(folder / "summary.json")
    scene = parse(content["scene"], source=f"{folder / 'summary.json'}: scene")
    names = [phase["name"] for phase in content["phases"]]
    if names != [phase.name for phase in scene.phases]:
        raise SceneError(f"{folder / 'summary.json'}: phases are not those of its scene")
    courses = _read_trajectory(folder / "trajectory.csv", names)
    return ResultFolder(content, scene, read_torque(folder / "torque.csv"), courses)


def render(written: ResultFolder) -> str:
    """A result as one HTML page."""
    pages = Environment(loader=PackageLoader("wholearm_jax.report", "templates"), autoescape=True, trim_blocks=True)
    pages.filters |= {"digits": _digits}
    summary = written.summary
    return pages.get_template("report.html").render(
        summary=summary,
        advice=Status[summary["status"].upper()].advice,
        worst=_worst(summary),
        rows=[row | {"reached": _reached(row)} for row in summary["phases"]],
        settings=_settings(summary),
        scene_toml=tomli_w.dumps(summary["scene"]),
        colours=_colours(),
        moves=bool(written.courses),
        rolls=any(name.endswith(" rolling") for row in summary["phases"] for name in row["contacts"]),
        data=_page_data(written),
    )


def _page_data(written: ResultFolder) -> dict[str, Any]:
    """What the page draws, in SI units: the hand, the object about its centre of mass, and every phase sampled."""
    scene, hand, solid = written.scene, written.scene.hand, rigid_body(written.scene.object)
    styles = contact_styles(row["contacts"] for row in written.summary["phases"])
    friction = np.asarray(scene.object.friction)
    end = max((float(rows[-1, 0]) for rows in written.courses.values()), default=0.0)
    phases = []
    for phase, row in zip(scene.phases, written.summary["phases"], strict=True):
        if row["name"] not in written.courses:
            continue
        table = written.courses[row["name"]]
        named = [
            {"name": name, "style": styles[name], "grip": float(friction[parse_contact(name)[0]])}
            | {"rolls": parse_contact(name)[3]}
            for name in row["contacts"]
        ]
        columns = _columns(table)
        count = len(named)
        phases.append(
            {
                "name": row["name"],
                "contacts": named,
                "t": _rounded(columns["t"]),
                "z": _rounded(columns["z"]),
                "tau": _rounded(columns["tau"]),
                "cn": _rounded(columns["cn"][:, :count]),
                "ct": _rounded(columns["ct"][:, :count]),
                "places": _rounded(_contact_positions(scene, phase.formation, columns["z"])),
            }
        )
    shown = {name: _rounded(np.asarray(getattr(hand, name))) for name in ("joint", "length", "offset", "torque_limit")}
    vertices = _rounded(np.asarray(solid.vertices)[: int(solid.count)])
    worst = _worst(written.summary)
    return {
        "hand": shown,
        "vertices": vertices,
        "phases": phases,
        "torque": _until(written.torque, end),
        "end": end,
        "margin": worst and {key: worst[key] for key in ("margin", "margin_time", "margin_contact")},
        "dashes": DASHES,
    }


def _until(torque: TorqueSchedule, end: float) -> dict[str, Any]:
    """The schedule's rows up to a time, and the torques then."""
    times, values = np.asarray(torque.times), np.asarray(torque.values)
    before = times <= end
    last = [np.interp(end, times, column) for column in values.T]
    return {"t": _rounded([*times[before], end]), "tau": _rounded([*values[before], last])}


def _contact_positions(scene: Scene, formation, z: np.ndarray) -> np.ndarray:
    """Where each contact is, and its normal into the object: `(samples, contacts, 4)`."""
    several = contact_set(rigid_body(scene.object), scene.hand, formation)

    @jax.jit
    @jax.vmap
    def at(z):
        found = contact_kinematics(several, z)
        return jax.numpy.stack([z[0] + found.from_object[0], z[1] + found.from_object[1], *found.normal], axis=1)

    return np.asarray(at(z))[:, list(formation.normal_rows)]


def _columns(table: np.ndarray) -> dict[str, np.ndarray]:
    """A phase's rows `t, z, z_dot, tau, c_n, c_t` as blocks."""
    many = len(COORDINATES)
    edges = np.cumsum([0, 1, many, many, 2, 4, 4])
    t, z, _, tau, cn, ct = (table[:, a:b] for a, b in itertools.pairwise(edges))
    return {"t": t[:, 0], "z": z, "tau": tau, "cn": cn, "ct": ct}


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file; optimise, simulate and search write it with --out") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    try:
        _Summary.model_validate(content)
    except ValidationError as error:
        raise SceneError(
            f"{path}: {explain_validation_error(error)}; it is not a summary that this library wrote"
        ) from None
    return content


def _read_trajectory(path: Path, names: list[str]) -> dict[str, np.ndarray]:
    """Phase name -> its rows without the name; empty cells are NaN."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SceneError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if tuple(header) != TRAJECTORY_COLUMNS:
        raise SceneError(f"{path}: line 1: the header must be {','.join(TRAJECTORY_COLUMNS)}")
    courses: dict[str, list] = {}
    for line, row in enumerate(rows, start=2):
        try:
            time, name, *numbers = row
            values = [float(time), *(float(v) if v else math.nan for v in numbers)]
        except ValueError:
            raise SceneError(f"{path}: line {line}: not a row of numbers") from None
        if name not in names or len(row) != len(header):
            raise SceneError(f"{path}: line {line}: not a row of any phase in summary.json")
        courses.setdefault(name, []).append(values)
    return {name: np.array(values) for name, values in courses.items()}


def _worst(summary: dict[str, Any]) -> dict[str, Any] | None:
    """The phase whose margin is the plan's (as `Result.critical_phase`); None where one has no margin."""
    pairs = zip(summary["phases"], summary["scene"]["phase"], strict=True)
    rows = [row for row, phase in pairs if not phase.get("hold")] or summary["phases"]
    return None if any(row["margin"] is None for row in rows) else min(rows, key=lambda row: row["margin"])


def _reached(row) -> str:
    """The share of its bound that a phase reached, in words: one that fails may not have come to the hard part."""
    top, margin = row["bound"], row["margin"]
    if row["status"] != Status.OK.label or not top or margin is None:
        return DASH
    return f"{100 * margin / top:.1f} %" if margin > 0 and top > 0 else DASH


def _settings(summary: dict[str, Any]) -> dict[str, str]:
    """How the result was made: all that the summary says beside the result itself."""
    known = {"status", "margin", "message", "phases", "scene", "stopped"}
    named = {"seconds": "time taken [s]", "steps": "steps of descent", "rate_limit": "largest torque rate [N m/s]"}
    named |= {"passing": "least speed at changes, over the mean", "hold_margin": "margin of the holds [N]"}
    named |= {"varied": "varied scenes", "arrival": "arrived within, of the wire's length"}
    named |= {"unseen_share": "share that holds of unseen scenes", "unseen_margin": "worst margin [N] of unseen scenes"}
    named |= {"unseen_share_nominal": "share that holds of unseen scenes, nominal schedule"}
    named |= {"unseen_margin_nominal": "worst margin [N] of unseen scenes, nominal schedule"}
    return {str(named.get(k, k)): _digits(v) for k, v in summary.items() if k not in known and v is not None}


def _colours() -> dict[str, dict[str, str]]:
    """CSS variables of the palette on white and on black."""

    def named(links, several):
        fingers = {f"finger{k + 1}": colour for k, colour in enumerate(links)}
        return fingers | {f"contact{k}": colour for k, colour in enumerate(several)}

    return {
        "light": named(LINK_COLOURS, CONTACT_COLOURS),
        "dark": named(DARK_LINK_COLOURS, DARK_CONTACT_COLOURS),
    }


def _digits(value, count: int = 4) -> str:
    """A number with so many digits; what is undefined is a dash."""
    if value is None:
        return DASH
    return f"{value:.{count}g}" if isinstance(value, float) else str(value)


def _rounded(values) -> Any:
    """Nested lists with seven significant digits, ten decimals at most, None for NaN: a small page."""
    values = np.asarray(values, float)
    if values.ndim == 0:
        return None if not math.isfinite(values) else float(f"{round(float(values), 10):.7g}")
    return [_rounded(v) for v in values]
