"""Scenes that are refused before they move: whether the status has a reason."""

import numpy as np

from benchmarks.stability import checks
from benchmarks.stability.levels import (
    APART,
    ASTRAY,
    COARSE,
    EMPTY,
    LONG,
    MISPLACED,
    OVERLAP,
    RANK,
    STILL,
    WEDGED,
    flag,
    picked,
)
from benchmarks.stability.links import Links, overlap
from tests.reference.mechanics import Model, dot

SHORTEST = 1e-9  # [object radii], a path that is shorter has no length


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
    links = Links.of(some, model.size)
    empty = (status == checks.LEFT) & (tables.breakpoints[:, -1] - tables.breakpoints[:, 0] < SHORTEST)
    empty &= paths.status != 0
    reason = np.select(
        [
            status == checks.OBSTACLE,
            empty & (paths.end_reason > 0),
            status == checks.LEFT,
            status == checks.MAX_STEPS,
            ~touching & (status != checks.SINGULAR),
            touching & (status == checks.SINGULAR) & still,
            (status == checks.SINGULAR) & (paths.status == 0),
            status == checks.SINGULAR,
            paths.status == 0,
        ],
        [OVERLAP, EMPTY, MISPLACED, LONG, APART, STILL, WEDGED, RANK, COARSE],
        ASTRAY,
    )
    out = checks.outside(model, start[:, None])[:, 0]
    deep = np.maximum(model.depth(start[:, None]), model.depth_of_corners(start[:, None]))[:, 0]
    behind = model.crossing(start[:, None])[:, 0]
    twice = checks.holds_one_tip(model, start, limits.place)
    in_place = (out < limits.closure) & (deep < limits.closure) & ~behind & ~twice
    flag(found, rows, "refused although in place", (reason == MISPLACED) & in_place)
    flag(found, rows, "refused although touching", (reason == APART) & some.exact & (status != checks.LEFT))
    deep = np.maximum(overlap(links, start[:, None]), 0.0)[:, 0]
    flag(found, rows, "refused although links are apart", (reason == OVERLAP) & ~(deep > limits.closure / 100))
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
    owner = np.repeat(paths.segment_of_panel, count, axis=1)[:, :, None]
    signs = [np.take_along_axis(np.asarray(s, float), owner, axis=1) for s in (paths.slip_sign, paths.joint_sign)]
    toward = np.take_along_axis(np.asarray(paths.chart, float), owner, axis=1)
    return checks.wedged(model, nodes.reshape(lanes, panels * count, 5), toward, signs[0])
