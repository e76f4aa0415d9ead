"""Simulated scenes: what must hold of their paths, tables, motions, margins and verdicts."""

import jax
import numpy as np

from benchmarks.stability import checks
from benchmarks.stability.levels import flag, to_device
from benchmarks.stability.links import Links, behind_in_object, meet, overlap
from benchmarks.stability.programs import follower
from benchmarks.stability.readings import GAUSS
from benchmarks.stability.scenes import Scenes
from tests.reference.mechanics import Model, dot
from wholearm_jax.simulation import IntegratorOptions

GRAINS = 100  # of a panel's rounding, what second derivatives read from it may be off


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
    check_path(found, rows, some, model, units, paths, tables, result, limits)
    check_motion(found, rows, model, units, result, limits)
    check_rest(found, rows, some, model, units, result, limits)
    found["status"][rows], found["table_status"][rows] = result.status, tables.status
    found["condition"][rows], found["table_error"][rows] = tables.condition, tables.error
    found["length"][rows] = tables.breakpoints[:, -1] - tables.breakpoints[:, 0]
    found["travel"][rows] = result.s
    found["moved"][rows] = result.moved
    found["torque"][rows] = result.torque.values
    found["steps"][rows], found["end_share"][rows] = result.count, result.phase_time
    found["path_end"][rows], found["pieces"][rows] = paths.end_reason, tables.count
    again = (result.status == checks.MAX_STEPS) | (found["energy"][rows] > limits.energy)
    return rows[again & (not final)]


def check_path(found, rows, some, model, units, paths, tables, result, limits):
    """The whole length of a path and its table."""
    along = units.remove(result.along)
    for name, value in checks.path_residuals(model, along).items():
        found[name][rows] = value.max(1)
    found["seam"][rows] = result.seam
    found["sign"][rows] = checks.path_signs(model, along).max(1)
    found["beyond"][rows] = checks.outside(model, along["z"]).max(1)
    links, stated = Links.of(some, model.size), some.flush_tolerance / model.size
    thick = (some.offset + some.back).max(1) > 0
    behind = np.where(thick[:, None], behind_in_object(model, links, along["z"]), 0.0).max(1)
    found["thickness"][rows] = behind  # against the object a link is its contact edge: counted, no violation
    found["depth"][rows] = depths(model, along["z"]).max(1)
    found["overlap"][rows] = overlap(links, along["z"]).max(1)
    flag(found, rows, "closure", found["closure"][rows] > limits.closure)
    flag(found, rows, "tangent", found["tangent"][rows] > limits.tables)
    flag(found, rows, "equations of the table", found["columns"][rows] > limits.tables)
    flag(found, rows, "seam between pieces", found["seam"][rows] > limits.tables)
    flag(found, rows, "sign within a piece", found["sign"][rows] > limits.sign)
    flag(found, rows, "contact beyond its feature", found["beyond"][rows] > limits.place)
    flag(found, rows, "link in the object", found["depth"][rows] > limits.place + stated)
    flag(found, rows, "links overlap", found["overlap"][rows] > limits.overlap)
    deep = (found["overlap"][rows] > limits.overlap) | (
        found["depth"][rows] > np.maximum(limits.overlap, 1.01 * stated)
    )
    flag(found, rows, "ok although links overlap", (result.status == checks.OK) & deep)
    until = some.until_coordinate, some.until_value / units.z[np.arange(len(rows)), some.until_coordinate]
    near = limits.place + stated  # what begins flush may stay as deep as it is
    real = checks.end_is_real(model, along["z"][:, -1], paths.end_reason, paths.end_contact, until, near)
    met = meet(links, along["z"][:, -1:], limits.place)[:, 0]
    flag(found, rows, "end without a cause", ~np.where(paths.end_reason == checks.MET, met, real))
    first, x = along["z"][:, 0], along["x"][:, 0]
    away = first - some.rough / units.z
    x = x / np.sqrt(dot(x, x))[:, None]
    lean = np.abs(dot(away, x)) / (np.sqrt(dot(away, away)) + 1e-3)
    settled = checks.rests_on_a_link(model, first, limits.place)  # a start that is meant flat is moved to where it is
    flag(found, rows, "start not the nearest", (lean > limits.tables * 10) & ~settled)
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
