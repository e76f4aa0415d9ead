"""The work of one process of the stability sweep: trace, simulate and check blocks of scenes, level by level."""

import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.stability import checks
from benchmarks.stability.programs import FLOATS, GAUSS, follower, forward, reverse, tracer
from benchmarks.stability.scenes import BLOCK, Scenes, draw
from tests.reference.mechanics import Model, dot
from wholearm_jax.core import configure
from wholearm_jax.simulation import Adjoint, IntegratorOptions
from wholearm_jax.tracing import Resolution

STATUSES = (
    *("ok", "contact_lost", "stuck", "reversed", "not_reached", "left_formation", "ambiguous", "singular"),
    *("no_convergence", "max_steps"),
)
REASONS = (
    "",
    "contacts do not touch",
    "start out of place",
    "heading names a still coordinate",
    "rank lost",
    "wedged by friction",
    "end or kink not located",
    "table too coarse",
    "path too long",
)
NONE, APART, MISPLACED, STILL, RANK, WEDGED, ASTRAY, COARSE, LONG = range(len(REASONS))


class Level(NamedTuple):
    """How finely paths are tabulated, steps and tolerance of a phase, and how many scenes share a program's run."""

    segments: int
    panels: int
    steps: int
    tolerance: float
    lanes: int


class Precision(NamedTuple):
    """Levels, the largest interpolation error of a table, and what counts as wrong."""

    levels: tuple[Level, ...]
    coarse: float
    limits: checks.Limits


DOUBLE = Precision(
    (Level(6, 64, 128, 1e-10, 64), Level(48, 512, 2048, 1e-12, 8), Level(48, 512, 16384, 1e-12, 4)),
    1e-9,
    checks.DOUBLE,
)
SINGLE = Precision(
    (Level(6, 64, 128, 1e-5, 64), Level(48, 512, 2048, 1e-5, 8)),
    1e-3,
    checks.SINGLE,
)


GRAINS = 100  # of a panel's rounding, what second derivatives read from it may be off
DIFFERENTIATED = 32  # scenes whose gradients are computed at once


def work(blocks, seed, *, single, target: Path):
    """Run blocks of scenes and write one record a scene."""
    configure(optimise_for="run_time")
    jax.config.update("jax_enable_x64", not single)
    records = []
    for block in blocks:
        begun = time.perf_counter()
        scenes = draw(BLOCK, 1_000_003 * seed + block)
        found = swept(scenes, SINGLE if single else DOUBLE)
        records.append(found | {"block": np.full(BLOCK, block), "row": np.arange(BLOCK)})
        counts = zip(np.bincount(found["status"], minlength=10), STATUSES, strict=True)
        named = ", ".join(f"{n} {name}" for n, name in counts if n)
        wrong = int((found["violations"] != 0).sum())
        print(f"block {block}: {time.perf_counter() - begun:.0f} s; {named}; {wrong} violations", flush=True)
    together = {key: np.concatenate([r[key] for r in records]) for key in records[0]}
    np.savez(target, **together)


def swept(scenes: Scenes, precision: Precision) -> dict[str, np.ndarray]:
    """One record a scene, from the first level at which nothing is left open."""
    found = blank(scenes)
    rows = np.arange(len(scenes.count))
    for number, level in enumerate(precision.levels):
        final = number == len(precision.levels) - 1
        later, ready = [], []
        for some, paths, tables in traced(scenes, rows, level):
            full = tables.count >= level.segments
            coarse = (tables.status == 0) & ~(tables.error <= precision.coarse)
            again = (full | coarse) & (not final) & (level.panels < precision.levels[-1].panels)
            status = np.where((tables.status == 0) & (full | coarse), checks.NO_CONVERGENCE, tables.status)
            later.append(some[again])
            refused = ~again & (status != 0)
            refuse(found, scenes, some, paths, tables, status, refused, precision.limits)
            good = np.flatnonzero(~again & (status == 0))
            ready.append((some[good], picked(paths, good), picked(tables, good)))
        found["level"][rows] = number
        for stepped in (False, True):
            for some, paths, tables in regrouped(ready, scenes, stepped, level.lanes):
                later.append(simulate(found, scenes, some, paths, tables, level, stepped, final, precision.limits))
        rows = np.sort(np.concatenate(later))
        if not len(rows):
            break
    for stepped in (False, True) if precision is DOUBLE else ():
        check_gradients(found, scenes, stepped, precision)
    return found


def blank(scenes: Scenes):
    """Records before anything is known."""
    n = len(scenes.count)
    whole = ("status", "table_status", "reason", "violations", "level", "steps", "wire_end", "pieces")
    real = ("margin", "scale", "condition", "table_error", "length", "travel", "end_share", *RESIDUALS, *EXCESSES)
    found = {name: np.zeros(n, int) for name in whole} | {name: np.full(n, np.nan) for name in real}
    found |= {"torque": np.zeros((n, *scenes.noise.shape[1:])), "moved": np.zeros(n, bool)}
    return found | {"family": scenes.family, "exact": scenes.exact, "at_rest": scenes.at_rest}


RESIDUALS = ("closure", "tangent", "columns", "seam", "motion", "constraint", "energy", "gradient")
EXCESSES = ("sign", "beyond", "depth", "margin_excess", "tension_missed")


def picked(tree, rows):
    """Some rows of arrays with a leading axis."""
    return jax.tree.map(lambda a: a[rows], tree)


def batches(count, lanes):
    """Row numbers in batches of one size; the last is filled up with repetitions, `real` says how many are not."""
    for first in range(0, count, lanes):
        rows = np.arange(first, min(first + lanes, count))
        yield np.resize(rows, lanes), len(rows)


def to_device(tree):
    """NumPy to JAX, floats in JAX's default precision."""
    return jax.tree.map(lambda a: jnp.asarray(a, float if a.dtype.kind == "f" else None), tree)


def traced(scenes, rows, level):
    """Wires and tables of some scenes, batch by batch, as NumPy."""
    program = tracer(Resolution(level.segments, level.panels, 8))
    for batch, real in batches(len(rows), level.lanes):
        some = rows[batch]
        paths, tables = program(to_device(Scenes(*scenes[some])))
        some = some[:real]
        paths, tables = jax.tree.map(lambda a, real=real: np.asarray(a)[:real], (paths, tables))
        yield some, paths, tables


def regrouped(ready, scenes, stepped, lanes):
    """Traced scenes with or without steps in their torque, in full batches."""
    if not ready:
        return
    rows = np.concatenate([some for some, _, _ in ready])
    paths, tables = (jax.tree.map(lambda *a: np.concatenate(a), *[part[k] for part in ready]) for k in (1, 2))
    mine = np.flatnonzero(scenes.stepped[rows] == stepped)
    for batch, real in batches(len(mine), lanes):
        at = mine[batch]
        yield (rows[at], real), picked(paths, at), picked(tables, at)


# --- refusals --------------------------------------------------------------------------------------------------------


def flag(found, rows, name, wrong):
    """Note a violation."""
    found["violations"][rows] |= np.where(wrong, 1 << checks.VIOLATIONS.index(name), 0)


def refuse(found, scenes, some, paths, tables, status, which, limits):
    """Record scenes without a table, and whether the status has a reason."""
    at = np.flatnonzero(which)
    if not len(at):
        return
    rows, paths, tables, status = some[at], picked(paths, at), picked(tables, at), status[at]
    some = scenes[rows]
    model = Model.of(some)
    start = np.asarray(paths.start, float)
    finite = np.isfinite(start).all(1)
    start = np.where(finite[:, None], start, 0.0)
    heading = np.zeros_like(start)
    heading[np.arange(len(at)), some.coordinate] = some.sign
    x = model.tangent(start[:, None], heading[:, None])[0][:, 0]
    touching = np.abs(model.geometry(start[:, None]).gap[:, 0]).max(1) < 100 * limits.closure
    still = np.abs(dot(x, heading)) < 1e-5
    reason = np.select(
        [
            status == checks.LEFT,
            status == checks.MAX_STEPS,
            ~touching & (status != checks.SINGULAR),
            touching & (status == checks.SINGULAR) & still,
            (status == checks.SINGULAR) & (paths.status == 0),
            status == checks.SINGULAR,
            paths.status == 0,
        ],
        [MISPLACED, LONG, APART, STILL, WEDGED, RANK, COARSE],
        ASTRAY,
    )
    out = checks.outside(model, start[:, None])[:, 0]
    deep = np.maximum(model.depth(start[:, None]), model.depth_of_corners(start[:, None]))[:, 0]
    behind = model.crossing(start[:, None])[:, 0]
    in_place = (out < limits.closure) & (deep < limits.closure) & ~behind
    flag(found, rows, "refused although in place", (reason == MISPLACED) & in_place)
    flag(found, rows, "refused although touching", (reason == APART) & some.exact & (status != checks.LEFT))
    rank = np.flatnonzero((reason == RANK) | (reason == ASTRAY))
    lost = np.zeros(len(at), bool)
    if len(rank):
        some_ranked = model.take(rank)
        lost[rank] = checks.loses_rank(some_ranked, start[rank], x[rank])
        z = (some.rough[rank] / checks.Units.of(some_ranked).z)[:, None]
        _, smallest, largest = some_ranked.tangent(z, heading[rank][:, None])
        lost[rank] |= (smallest < 1e-5 * largest)[:, 0]
    wedge = np.zeros(len(at), bool)
    some_wedged = np.flatnonzero(reason == WEDGED)
    if len(some_wedged):
        wedge[some_wedged] = wedged(model.take(some_wedged), picked(paths, some_wedged))
    flag(found, rows, "singular without a reason", ((reason == RANK) & ~lost) | ((reason == WEDGED) & ~wedge))
    found["status"][rows], found["table_status"][rows], found["reason"][rows] = status, status, reason
    found["condition"][rows], found["table_error"][rows] = tables.condition, tables.error
    found["pieces"][rows] = tables.count


def wedged(model, paths):
    """Whether friction wedges the object at a node of its path, by the other model."""
    nodes = np.asarray(paths.nodes, float)
    lanes, panels, count, _ = nodes.shape
    owner = np.repeat(paths.owner, count, axis=1)[:, :, None]
    signs = [np.take_along_axis(np.asarray(s, float), owner, axis=1) for s in (paths.slip_sign, paths.joint_sign)]
    toward = np.take_along_axis(np.asarray(paths.chart, float), owner, axis=1)
    return checks.wedged(model, nodes.reshape(lanes, panels * count, 5), toward, signs[0])


# --- motions ---------------------------------------------------------------------------------------------------------


def simulate(found, scenes, which, paths, tables, level, stepped, final, limits):
    """Simulate, check and record a batch; returns the rows that need more steps or a tighter tolerance."""
    rows, real = which
    how = IntegratorOptions(
        max_steps=level.steps, max_stages=max(8, level.steps // 128), tolerance=level.tolerance, has_jumps=stepped
    )
    result = follower(how)(to_device(paths), to_device(tables), to_device(Scenes(*scenes[rows])))
    paths, tables, result = jax.tree.map(lambda a: np.asarray(a)[:real], (paths, tables, result))
    rows = rows[:real]
    some = scenes[rows]
    model = Model.of(some)
    units = checks.Units.of(model)
    found["violations"][rows] = 0
    check_wire(found, rows, some, model, units, paths, tables, result, limits)
    check_motion(found, rows, model, units, result, limits)
    check_rest(found, rows, some, model, units, result, limits)
    found["status"][rows], found["table_status"][rows] = result.status, tables.status
    found["condition"][rows], found["table_error"][rows] = tables.condition, tables.error
    found["length"][rows] = tables.breakpoints[:, -1] - tables.breakpoints[:, 0]
    found["travel"][rows] = result.s
    found["moved"][rows] = result.moved
    found["torque"][rows] = result.torque.values
    found["steps"][rows], found["end_share"][rows] = result.count, result.phase_time
    found["wire_end"][rows], found["pieces"][rows] = paths.end_reason, tables.count
    again = (result.status == checks.MAX_STEPS) | (found["energy"][rows] > limits.energy)
    return rows[again & (not final)]


def check_wire(found, rows, some, model, units, paths, tables, result, limits):
    """The whole length of a path and its table."""
    along = units.remove(result.along)
    for name, value in checks.wire_residuals(model, along).items():
        found[name][rows] = value.max(1)
    found["seam"][rows] = result.seam
    found["sign"][rows] = checks.wire_signs(model, along).max(1)
    found["beyond"][rows] = checks.outside(model, along["z"]).max(1)
    found["depth"][rows] = depths(model, along["z"]).max(1)
    flag(found, rows, "closure", found["closure"][rows] > limits.closure)
    flag(found, rows, "tangent", found["tangent"][rows] > limits.tables)
    flag(found, rows, "equations of the table", found["columns"][rows] > limits.tables)
    flag(found, rows, "seam between pieces", found["seam"][rows] > limits.tables)
    flag(found, rows, "sign within a piece", found["sign"][rows] > limits.sign)
    flag(found, rows, "contact beyond its feature", found["beyond"][rows] > limits.place)
    flag(found, rows, "link in the object", found["depth"][rows] > limits.place)
    until = some.until_coordinate, some.until_value / units.z[np.arange(len(rows)), some.until_coordinate]
    real = checks.end_is_real(model, along["z"][:, -1], paths.end_reason, paths.end_contact, until, limits.place)
    flag(found, rows, "end without a cause", ~real)
    first, x = along["z"][:, 0], along["x"][:, 0]
    away = first - some.rough / units.z
    x = x / np.sqrt(dot(x, x))[:, None]
    lean = np.abs(dot(away, x)) / (np.sqrt(dot(away, away)) + 1e-3)
    flag(found, rows, "start not the nearest", lean > limits.tables * 10)
    flag(found, rows, "start heads the wrong way", x[np.arange(len(rows)), some.coordinate] * some.sign <= 0)


def depths(model, z):
    """How deep the hand is in the object: corners everywhere, edges where an object's vertex lies behind a link."""
    depth = model.depth_of_corners(z)
    lane, place = np.nonzero(model.crossing(z))
    if len(lane):
        edges = model.take(lane).depth(z[lane, place][:, None])[:, 0]
        depth[lane, place] = np.maximum(depth[lane, place], edges)
    return depth


def check_motion(found, rows, model, units, result, limits):
    """The equations of motion at times, energy from start to end, and the margin against forces within steps."""
    at = units.remove(result.at)
    live = ~result.at["held"] & result.moved[:, None]
    for name, value in checks.motion_residuals(model, at).items():
        found[name][rows] = np.where(live, value, 0.0).max(1)
    steps = max(1, int(result.count.max()))
    width = result.within["width"][:, :steps, None] * GAUSS[1] / 2 * ~result.within["held"][:, :steps]
    within = {key: value[:, :steps] for key, value in result.within.items() if key != "width"}
    within = {key: value.reshape(len(rows), -1, *value.shape[3:]) for key, value in within.items()}
    within = units.remove(within)
    weights = width.reshape(len(rows), -1)
    moving = result.moved & (result.status != checks.MAX_STEPS)
    energy = checks.energy_residual(model, units.remove(result.ends), within, weights)
    found["energy"][rows] = np.where(moving, energy, np.nan)
    force = np.where((weights > 0)[..., None], within["force"], np.nan)
    scale = np.where((weights > 0)[..., None], within["parts"], 0.0).max((1, 2))
    slack = model.slack(force)
    least = np.nanmin(slack, axis=(1, 2), initial=np.inf)
    margin = result.margin / units.force
    found["margin"][rows], found["scale"][rows] = np.where(moving, margin, np.nan), scale
    excess = np.where(moving, margin, 0.0) - np.where(moving, least, 0.0)
    excess /= np.maximum(scale, 1e-300)
    found["margin_excess"][rows] = np.maximum(excess, 0.0)
    before = within["share"] < np.where(np.isfinite(result.loss_time), result.loss_time * (1 - 1e-9), np.inf)[:, None]
    early = np.nanmin(np.where(before[..., None], slack, np.nan), axis=(1, 2), initial=np.inf)
    early = np.where(moving & np.isfinite(early), early, 0.0)
    found["tension_missed"][rows] = np.maximum(-early / np.maximum(scale, 1e-300), 0.0)
    flag(found, rows, "number missing", ~result.finite | (moving & ~np.isfinite(result.margin)))
    allowed = limits.motion + GRAINS * result.grain
    flag(found, rows, "equations of motion", found["motion"][rows] > allowed)
    flag(found, rows, "constraint", found["constraint"][rows] > allowed)
    flag(found, rows, "energy", moving & ~(energy < limits.energy))
    flag(found, rows, "margin above a force", found["margin_excess"][rows] > limits.motion)
    good = (result.status == checks.OK) | (result.moving_status == checks.OK)
    flag(found, rows, "ok with a tensile force", good & moving & ~(result.margin >= 0))
    flag(found, rows, "tension not seen in time", found["tension_missed"][rows] > limits.motion)


def check_gradients(found, scenes, stepped, precision):
    """Gradients of the margin wherever a plan succeeds at the first level: finite, and the same in both modes.

    The margin that comes with them, from steps that are taken again, must be that of the simulation.
    """
    level, limits = precision.levels[0], precision.limits
    good = (found["status"] == checks.OK) & found["moved"] & (found["level"] == 0) & (scenes.stepped == stepped)
    rows = np.flatnonzero(good)
    how = IntegratorOptions(
        max_steps=level.steps, max_stages=8, tolerance=level.tolerance, has_jumps=stepped, adjoint=Adjoint.BOTH
    )
    for batch, real in batches(len(rows), DIFFERENTIATED):
        some = to_device(Scenes(*scenes[rows[batch]]))
        floats = {name: getattr(some, name) for name in FLOATS} | {"torque": to_device(found["torque"][rows[batch]])}
        rng = np.random.default_rng(rows[batch][0])
        way = {name: a * rng.uniform(-1.0, 1.0, a.shape).astype(a.dtype) for name, a in floats.items()}
        margin, along = (np.asarray(a)[:real] for a in forward(how)(floats, way, some))
        here = rows[batch][:real]
        newtons = checks.Units.of(Model.of(scenes[here])).force
        scale = found["scale"][here] * newtons
        slopes = {name: np.asarray(a) for name, a in reverse(how)(floats, some).items()}
        terms = [(slopes[name] * way[name]).reshape(len(batch), -1)[:real] for name in floats]
        size = sum(np.abs(t).sum(1) for t in terms) + scale
        apart = np.abs(sum(t.sum(1) for t in terms) - along) / np.maximum(size, 1e-300)
        finite = np.all([np.isfinite(t).all(1) for t in terms], axis=0) & np.isfinite(along)
        found["gradient"][here] = apart
        flag(found, here, "gradient not finite", ~finite)
        flag(found, here, "modes of gradients differ", finite & (apart > limits.gradient))
        other = np.abs(margin - found["margin"][here] * newtons) > limits.motion * scale
        flag(found, here, "margin that comes with a gradient", other)


def check_rest(found, rows, some, model, units, result, limits):
    """How motions begin and end: what an object at rest does, and where it stands when it ends."""
    times = some.knots
    value = np.asarray(result.torque.values, float) / units.torque[:, None, None]
    ends = units.remove(result.ends)
    verdict_at = np.where(result.ended == checks.STUCK, result.rest, result.phase_time)
    for name, place, begin, stop, status in (
        ("rest contradicts accelerations", 1, verdict_at, 1.0, result.ended),
        ("departure contradicts accelerations", 0, 0.0 * result.rest, result.departs, None),
    ):
        rest = checks.Rest(model, ends["z"][:, place], ends["x"][:, place])
        begin, stop = np.broadcast_to(begin, len(rows)), np.broadcast_to(stop, len(rows))
        inside = (times > begin[:, None]) & (times < stop[:, None] - 1e-12)
        first, last = (torque_at(times, value, at, side) for at, side in ((begin, "right"), (stop, "left")))
        torque = np.concatenate([first[:, None], value, last[:, None]], axis=1)
        live = np.concatenate([np.ones((len(rows), 1), bool), inside, np.ones((len(rows), 1), bool)], axis=1)
        if status is not None:
            wrong = checks.resting_verdicts(rest, status, torque, live, limits.sign)
        else:
            wrong = checks.departures(rest, torque, live, torque_at(times, value, stop, "right"), limits.sign)
            wrong &= result.moved & (result.ended != checks.MAX_STEPS)
        flag(found, rows, name, wrong)
    arrived = (result.ended == checks.LEFT) & ~(np.abs(result.s - result.length) < 1e-6 * result.length)
    early = (result.ended == checks.OK) & ~(np.abs(result.phase_time - 1) < 1e-6)
    halted = np.isin(result.ended, (checks.STUCK, checks.REVERSED, checks.AMBIGUOUS)) & ~(result.w == 0)
    flag(found, rows, "end of the motion", arrived | early | halted)


def torque_at(times, values, at, side):
    """The schedule at one time a scene, from the left or the right of a step."""
    count = times.shape[1]
    k = (times <= at[:, None] + 1e-12).sum(1) - 1 if side == "right" else (times < at[:, None] - 1e-12).sum(1) - 1
    k = np.clip(k, 0, count - 2)
    row = np.arange(len(at))
    gap = times[row, k + 1] - times[row, k]
    share = np.where(gap > 0, (at - times[row, k]) / np.where(gap > 0, gap, 1.0), 0.0)
    return values[row, k] + (values[row, k + 1] - values[row, k]) * share[:, None]
