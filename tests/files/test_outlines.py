"""Drawings become outlines: twenty of different kinds, their areas and vertices known without the package."""

import math
import sys

import ezdxf
import numpy as np
import pytest
import shapely

import wholearm_jax as wa
from wholearm_jax.core import DoubtfulInput, SceneError
from wholearm_jax.files import read_outline, read_outlines

BOX = [(0, 0), (60, 0), (60, 40), (0, 40)]
BRACKET = [(0, 0), (60, 0), (60, 20), (20, 20), (20, 50), (0, 50)]
TOLERANCE = 0.05  # mm


def dxf(path, draw, units=4):
    document = ezdxf.new("R2010")
    document.header["$INSUNITS"] = units
    draw(document.modelspace(), document)
    document.saveas(path)
    return path


def closed(points, **more):
    return lambda msp, _: msp.add_lwpolyline(points, close=True, **more)


def lines(*points, skip=(), repeat=(), shift=0.0):
    """Single lines from point to point, without some, some twice, the first one too long by `shift`."""

    def draw(msp, _):
        for k, (here, there) in enumerate(zip(points, points[1:] + points[:1], strict=True)):
            for _ in range(0 if k in skip else 2 if k in repeat else 1):
                ends = (here, there) if k % 2 else (there, here)
                msp.add_line(ends[0], (ends[1][0] + (shift if k == 0 else 0.0), ends[1][1]))

    return draw


def diagonal(msp, document):
    lines(*BOX)(msp, document)
    msp.add_line(BOX[0], BOX[2])


def slot(msp, _):
    msp.add_line((0, 0), (40, 0))
    msp.add_arc((40, 10), 10, -90, 90)
    msp.add_line((40, 20), (0, 20))
    msp.add_arc((0, 10), 10, 90, 270)


def block(msp, document):
    part = document.blocks.new("PART")
    part.add_lwpolyline(BOX, close=True)
    outer = document.blocks.new("OUTER")
    outer.add_blockref("PART", (3, 4), dxfattribs={"rotation": 30})
    msp.add_blockref("OUTER", (100, 0), dxfattribs={"xscale": -2, "yscale": 2})


def text_and_hidden(msp, document):
    msp.add_lwpolyline(BOX, close=True)
    msp.add_text("PART")
    msp.add_linear_dim(base=(0, -10), p1=(0, 0), p2=(60, 0)).render()
    document.layers.add("construction").off()
    msp.add_line((0, 0), (99, 99), dxfattribs={"layer": "construction"})


def spline(msp, _):
    """A closed cubic B-spline: its area by the exact integral of its Bezier pieces."""
    msp.add_spline(degree=3).set_closed([(*point, 0) for point in BOX])


def uniform_spline_area(points):
    """Area in a closed uniform cubic B-spline, by Gauss points that are exact for its polynomials."""
    x, w = np.polynomial.legendre.leggauss(6)
    t, total = (x + 1) / 2, 0.0
    basis = np.array([[-1, 3, -3, 1], [3, -6, 3, 0], [-3, 0, 3, 0], [1, 4, 1, 0]]) / 6
    powers = np.array([t**3, t**2, t, np.ones_like(t)])
    slopes = np.array([3 * t**2, 2 * t, np.ones_like(t), 0 * t])
    for k in range(len(points)):
        control = np.array([points[(k + j) % len(points)] for j in range(4)], float)
        place, rate = powers.T @ basis @ control, slopes.T @ basis @ control
        total += (w / 2 * (place[:, 0] * rate[:, 1] - place[:, 1] * rate[:, 0])).sum() / 2
    return total


def svg(path, body, attributes='width="60mm" height="40mm" viewBox="0 0 600 400"'):
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {attributes}>{body}</svg>')
    return path


def stl(path, points, taper=1.0):
    """The side faces of an extruded polygon, ASCII."""
    text = ["solid part"]
    for here, there in zip(points, points[1:] + points[:1], strict=True):
        low = [(*here, 0), (*there, 0)]
        high = [(taper * x, taper * y, 10) for x, y in (here, there)]
        for face in ((low[0], low[1], high[1]), (low[0], high[1], high[0])):
            corners = "\n".join(f"vertex {x} {y} {z}" for x, y, z in face)
            text.append(f"facet normal 0 0 0\nouter loop\n{corners}\nendloop\nendfacet")
    path.write_text("\n".join([*text, "endsolid part\n"]))
    return path


def csv(path, text):
    path.write_text(text)
    return path


CIRCLE = math.pi * 20**2
DRAWINGS = {
    "closed polyline": (lambda p: dxf(p / "a.dxf", closed(BOX)), {}, 2400, BOX),
    "single lines": (lambda p: dxf(p / "a.dxf", lines(*BRACKET)), {}, 1800, BRACKET),
    "lines drawn twice": (lambda p: dxf(p / "a.dxf", lines(*BRACKET, repeat=(1, 4))), {}, 1800, BRACKET),
    "small gaps": (lambda p: dxf(p / "a.dxf", lines(*BOX, shift=0.02)), {}, 2400, None),
    "repeated vertices": (lambda p: dxf(p / "a.dxf", closed([BOX[0], *BOX[:3], (30, 40), BOX[3]])), {}, 2400, BOX),
    "centimetres": (lambda p: dxf(p / "a.dxf", closed(BOX), units=5), {}, 240000, None),
    "inches": (lambda p: dxf(p / "a.dxf", closed([(0, 0), (2, 0), (2, 1)]), units=1), {}, 25.4**2, None),
    "unit given": (lambda p: dxf(p / "a.dxf", closed(BOX), units=0), {"unit": "mm"}, 2400, BOX),
    "circle": (lambda p: dxf(p / "a.dxf", lambda m, _: m.add_circle((5, 5), 20)), {}, CIRCLE, None),
    "bulges": (lambda p: dxf(p / "a.dxf", closed([(-20, 0, 1), (20, 0, 1)], format="xyb")), {}, CIRCLE, None),
    "slot of arcs": (lambda p: dxf(p / "a.dxf", slot), {}, 800 + math.pi * 100, None),
    "ellipse": (
        lambda p: dxf(p / "a.dxf", lambda m, _: m.add_ellipse((0, 0), (30, 10), 0.5)),
        {},
        math.pi * 1000 * 0.5,
        None,
    ),
    "spline": (lambda p: dxf(p / "a.dxf", spline), {}, uniform_spline_area(BOX), None),
    "nested blocks, mirrored": (lambda p: dxf(p / "a.dxf", block), {}, 9600, None),
    "text and hidden layers": (lambda p: dxf(p / "a.dxf", text_and_hidden), {}, 2400, BOX),
    "SVG transforms": (
        lambda p: svg(p / "a.svg", '<g transform="rotate(30) scale(2 1)"><rect width="300" height="400"/></g>'),
        {},
        2400,
        None,
    ),
    "SVG path": (
        lambda p: svg(p / "a.svg", '<path d="M0 0 h600 v400 H0 z"/>'),
        {},
        2400,
        [(x, -y) for x, y in BOX],
    ),
    "SVG curves": (
        lambda p: svg(p / "a.svg", '<path d="M0 0 Q300 300 600 0 A300 300 0 0 1 0 0"/>'),
        {},
        math.pi * 30**2 / 2 - 2 / 3 * 60 * 15,
        None,
    ),
    "SVG pixels": (lambda p: svg(p / "a.svg", '<circle r="96"/>', ""), {}, math.pi * 25.4**2, None),
    "SVG unit given": (
        lambda p: svg(p / "a.svg", "<use href='#r'/><defs><rect id='r' width='60' height='40'/></defs>"),
        {"unit": "mm"},
        2400,
        None,
    ),
    "CSV with a header": (lambda p: csv(p / "a.csv", "x [mm],y [mm]\n0,0\n60,0\n60,40\n0,40\n0,0\n"), {}, 2400, BOX),
    "CSV of a spreadsheet": (
        lambda p: csv(p / "a.csv", "# part\n0;0\n0;0,04\n0,06;0,04\n0,06;0\n"),
        {"unit": "m"},
        2400,
        BOX,
    ),
    "STL": (lambda p: stl(p / "a.stl", BRACKET), {"unit": "mm"}, 1800, BRACKET),
}
REFUSED = {
    "open": (lambda p: dxf(p / "a.dxf", lines(*BOX, skip=(2,))), r"open contour: a line ends at \(\d+, 40\)"),
    "gap": (lambda p: dxf(p / "a.dxf", lines(*BOX, shift=0.2)), r"the nearest end is 0.2 away"),
    "branch": (lambda p: dxf(p / "a.dxf", diagonal), r"3 lines meet at \((0, 0|60, 40)\)"),
    "bow tie": (
        lambda p: dxf(p / "a.dxf", closed([(0, 0), (60, 40), (60, 0), (0, 40)])),
        r"the contour at \(30, 20\) crosses or touches itself",
    ),
    "no area": (lambda p: dxf(p / "a.dxf", closed([(0, 0), (60, 0), (30, 0)])), "has no area"),
    "no unit": (lambda p: dxf(p / "a.dxf", closed(BOX), units=0), r"its unit is not given \(\$INSUNITS is 0\)"),
    "text alone": (lambda p: dxf(p / "a.dxf", lambda m, _: m.add_text("A")), "no curves in it; passed over: 1 TEXT"),
    "hole": (
        lambda p: svg(p / "a.svg", '<rect width="600" height="400"/><circle cx="99" cy="99" r="9"/>'),
        "the outline has 1 hole; ",
    ),
    "several": (
        lambda p: dxf(p / "a.dxf", lambda m, _: [m.add_circle((90 * k, 0), 10) for k in (0, 1)]),
        r"2 outlines \(1: 313.* mm\^2, 20 x 20 mm; 2: .*choose one by its number",
    ),
    "crossing": (
        lambda p: dxf(p / "a.dxf", lambda m, _: [m.add_circle((9 * k, 0), 10) for k in (0, 1)]),
        "two contours cross",
    ),
    "no DXF": (lambda p: csv(p / "a.dxf", "hello"), "not a DXF file that can be read"),
    "no SVG": (lambda p: csv(p / "a.svg", "<html></html>"), "its outermost element is <html>"),
    "no STL": (lambda p: csv(p / "a.stl", "solid\n"), "not an STL file"),
    "STL without a unit": (lambda p: stl(p / "a.stl", BOX), "does not say its unit"),
    "CSV words": (lambda p: csv(p / "a.csv", "x [mm],y [mm]\n0,0\n1,one\n"), "line 3: '1,one' is not two numbers"),
    "CSV without a unit": (lambda p: csv(p / "a.csv", "0,0\n1,0\n1,1\n"), "its unit is not given; write a header"),
    "another kind": (lambda p: csv(p / "a.png", ""), "a drawing is a file that ends in .dxf"),
    "no file": (lambda p: p / "b.dxf", "no such file"),
}


def as_set(points):
    return {tuple(np.round(point, 3) + 0.0) for point in np.asarray(points, float)}


@pytest.mark.parametrize("kind", DRAWINGS)
def test_drawings_are_read(kind, tmp_path):
    draw, options, area, vertices = DRAWINGS[kind]
    outline = read_outline(draw(tmp_path), **options)
    ring = shapely.Polygon(1e3 * outline.vertices)
    assert ring.is_valid
    assert ring.exterior.is_ccw
    assert abs(ring.area - area) <= TOLERANCE * ring.length
    assert 1e6 * outline.area == pytest.approx(ring.area, rel=1e-12)
    np.testing.assert_allclose(1e3 * np.array(outline.centroid), ring.centroid.coords[0], atol=1e-9)
    if vertices is not None:
        assert as_set(1e3 * outline.vertices) == as_set(vertices)


@pytest.mark.parametrize("kind", REFUSED)
def test_other_drawings_are_refused_in_one_line(kind, tmp_path):
    draw, message = REFUSED[kind]
    path = draw(tmp_path)
    with pytest.raises(SceneError, match=message) as refusal:
        read_outline(path, unit="mm" if kind == "no STL" else None)
    assert str(refusal.value).startswith(f"{path}: ")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("tolerance", [1.0, 0.1, 0.01])
def test_curves_become_edges_within_the_tolerance(tolerance, tmp_path):
    """Of a circle, an ellipse and a cubic curve: as far from the true curve as allowed, and no more vertices than that
    needs."""
    draw = '<path d="M 0 0 C 0 60 60 60 60 0 A 30 20 0 0 0 0 0"/>'
    outline = read_outline(svg(tmp_path / "a.svg", draw), unit="mm", tolerance=1e-3 * tolerance)
    t = np.linspace(0, 1, 20001)
    cubic = np.stack([180 * t**2 * (1 - t) + 60 * t**3, -180 * t * (1 - t) ** 2 - 180 * t**2 * (1 - t)], axis=1)
    arc = np.stack([30 + 30 * np.cos(np.pi * t), 20 * np.sin(np.pi * t)], axis=1)
    curve = shapely.LinearRing(np.concatenate([cubic, arc]))
    edges = shapely.LinearRing(1e3 * outline.vertices)
    off = max(edges.distance(shapely.Point(p)) for p in curve.coords[::10])
    assert 0.2 * tolerance < off <= tolerance * 1.02
    assert len(outline.vertices) < 60 / math.sqrt(tolerance)


def test_holes_take_from_mass_but_not_from_the_outline(tmp_path):
    """A ring: its second moment is that of the difference of two discs."""
    draw = '<circle cx="50" cy="50" r="40"/><circle cx="50" cy="50" r="20"/><rect x="45" y="45" width="9" height="9"/>'
    path = svg(tmp_path / "ring.svg", draw, 'width="100" height="100"')
    outer, inner = read_outlines(path, unit="mm", tolerance=1e-6)
    assert (len(outer.holes), len(inner.holes)) == (1, 0)
    assert outer.area == pytest.approx(math.pi * (0.04**2 - 0.02**2), rel=1e-3)
    assert outer.second_moment == pytest.approx(math.pi / 2 * (0.04**4 - 0.02**4), rel=1e-3)
    assert inner.area == pytest.approx(81e-6, rel=1e-4)
    scene = wa.scene_from_outline(read_outline(path, unit="mm", number=1, fill_holes=True), mass=0.5)
    assert float(scene.object.inertia) == pytest.approx(0.5 / 2 * (0.04**2 + 0.02**2), rel=2e-3)


def test_a_body_that_is_no_prism_is_noted(tmp_path):
    with pytest.warns(DoubtfulInput, match="not a prism along z"):
        outline = read_outline(stl(tmp_path / "a.stl", BOX, taper=0.5), unit="mm")
    assert outline.size == pytest.approx((0.045, 0.03), abs=1e-4)


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    path = dxf(tmp_path / "a.dxf", closed(BOX))
    monkeypatch.delitem(sys.modules, "wholearm_jax.files.dxf_curves", raising=False)
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(SceneError, match=r"reading it needs ezdxf: pip install 'wholearm_jax\[cad\]'"):
        read_outline(path)
