"""Outlines of objects: defects are found and named as by comparing all edges one by one, and fast."""

import itertools
import time

import numpy as np
import pytest
from support import layered

from wholearm_jax.files.scene_toml import load, parse, to_dict
from wholearm_jax.model.outline import find_defect, remains_simple

SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]


def side(a, b, c):
    return np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def within(a, b, c):
    return bool(np.all(np.minimum(a, b) <= c) and np.all(c <= np.maximum(a, b)))


def first_crossing(outline):
    """The first two edges that touch without being neighbours, or fold back, by comparing each with each."""
    count = len(outline)
    for i, j in itertools.combinations(range(count), 2):
        a, b, c, d = (outline[k % count] for k in (i, i + 1, j, j + 1))
        if j == i + 1 or (i == 0 and j == count - 1):
            before, shared, after = (a, b, d) if j == i + 1 else (c, a, b)
            if side(before, shared, after) == 0 and (before - shared) @ (after - shared) > 0:
                return i, j
            continue
        turns = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
        ends = (a, b, c), (a, b, d), (c, d, a), (c, d, b)
        touching = any(turn == 0 and within(*three) for turn, three in zip(turns, ends, strict=True))
        if (turns[0] * turns[1] < 0 and turns[2] * turns[3] < 0) or touching:
            return i, j
    return None


@pytest.mark.parametrize("size", [3, 4, 5, 6, 8, 12])
def test_random_outlines_are_judged_as_by_comparing_all_edges(size):
    """On a grid, vertices and edges often touch exactly."""
    rng = np.random.default_rng(size)
    found = {"none": 0, "crossing": 0}
    for k, outline in enumerate(rng.integers(-6, 7, (300, size, 2)).astype(float)):
        if k % 2:  # in turn about the middle: often simple
            outline = outline[np.argsort(np.arctan2(*(outline - outline.mean(0)).T[::-1]))]
        defect = find_defect(outline[None])
        if defect is not None and "degenerate" in defect[1]:
            continue
        crossing = first_crossing(outline)
        if crossing is not None:
            assert defect is not None
            assert defect[1].startswith("edges {} and {} cross or touch".format(*crossing)), outline.tolist()
            found["crossing"] += 1
        else:
            area = sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(outline, np.roll(outline, -1, 0), strict=True))
            assert (defect is None) == (area > 0)
            found["none"] += defect is None
    assert found["none"] > 0
    assert found["crossing"] > 0 or size == 3


DEFECTS = {
    "a vertex on an edge": ([[0, 0], [4, 0], [4, 4], [2, 0], [0, 4]], "edges 0 and 2 cross or touch"),
    "two vertices at one place": ([[0, 0], [2, 1], [4, 0], [4, 2], [2, 1], [0, 2]], "edges 0 and 3 cross or touch"),
    "a spike": ([[0, 0], [4, 0], [4, 4], [4, 8], [4, 4], [0, 4]], "edges 1 and 3 cross or touch"),
    "the last edge on the first": ([[0, 0], [4, 0], [4, 4], [2, 0]], "edges 0 and 2 cross or touch"),
    "a bow": ([[0, 0], [1, 1], [1, 0], [0, 1]], "edges 0 and 2 cross or touch"),
    "clockwise": (SQUARE[::-1], "clockwise"),
    "on a line": ([[0, 0], [1, 1], [2, 2]], "degenerate: the vertices lie on one line"),
    "twice": ([[0, 0], [1, 0], [1, 0], [0, 1]], "degenerate: vertices 1 and 2 coincide"),
    "closed": ([*SQUARE, SQUARE[0]], "degenerate: vertices 4 and 0 coincide"),
}


@pytest.mark.parametrize(("outline", "cause"), DEFECTS.values(), ids=DEFECTS.keys())
@pytest.mark.parametrize("offset", [0.0, 1024.0])
def test_defects_are_named(outline, cause, offset):
    row, message = find_defect(np.asarray(outline, float)[None] + offset)
    assert row == 0
    assert message.startswith(cause)


@pytest.mark.parametrize(
    "outline", [SQUARE, [[0, 0], [1, 0], [2, 0], [2, 2], [0, 2]], [[0, 0], [4, 0], [1, 1], [0, 4]]]
)
def test_polygons_have_none(outline):
    assert find_defect(np.asarray(outline, float)[None]) is None


def test_the_first_of_many_is_named():
    outlines = np.stack([SQUARE, SQUARE, DEFECTS["a bow"][0], SQUARE[::-1]]).astype(float)
    assert find_defect(outlines) == (2, "edges 0 and 2 cross or touch: the polygon intersects itself")


def outline_of(count):
    angle = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    radius = 0.04 * (1 + 0.1 * np.cos(5 * angle))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def test_ten_thousand_vertices_take_less_than_a_second():
    data = to_dict(layered("heptagon"))
    data["object"]["vertices"] = outline_of(10_000).tolist()
    begun = time.process_time()
    scene = parse(data)
    assert time.process_time() - begun < 1.0
    assert int(scene.object.count) == 10_000


def test_the_case_of_eight_hundred_vertices(request):
    begun = time.process_time()
    scene = load(request.path.parents[1] / "data" / "cases" / "outline_800.toml")
    assert time.process_time() - begun < 1.0
    assert int(scene.object.count) == 800


def test_a_crossing_among_ten_thousand_vertices_is_named():
    outline = outline_of(10_000)
    outline[[7000, 7001]] = outline[[7001, 7000]]
    begun = time.process_time()
    assert find_defect(outline[None])[1].startswith("edges 6999 and 7001 cross or touch")
    assert time.process_time() - begun < 1.0


@pytest.mark.parametrize(("moves", "surely"), [(0.0, True), (0.49, True), (0.51, False)])
def test_a_polygon_remains_simple_while_no_vertex_reaches_an_edge(moves, surely):
    """Opposite sides of a unit square are one apart."""
    assert remains_simple(np.asarray(SQUARE), np.full(4, moves)) == surely


def test_each_vertex_moves_by_its_own_part():
    assert remains_simple(np.asarray(SQUARE), np.array([0.9, 0.0, 0.0, 0.0]))
    assert not remains_simple(np.asarray(SQUARE), np.array([0.9, 0.2, 0.0, 0.0]))


@pytest.mark.parametrize("count", [7, 50])
def test_simplicity_by_trees_is_that_of_all_pairs(count):
    rng = np.random.default_rng(count)
    outline, answers = outline_of(count), []
    after = np.roll(outline, -1, axis=0)
    for largest in np.geomspace(1e-5, 0.05, 12):
        moves = rng.uniform(0, largest, count)
        reach = np.maximum(moves, np.roll(moves, -1))
        safe = True
        for v, e in itertools.product(range(count), range(count)):
            if v not in (e, (e + 1) % count):
                along, to = after[e] - outline[e], outline[v] - outline[e]
                nearest = np.clip(to @ along / (along @ along), 0, 1)
                safe &= np.linalg.norm(to - nearest * along) > moves[v] + reach[e]
        assert remains_simple(outline, moves) == safe
        answers.append(safe)
    assert {True, False} == set(answers)
