"""From a drawing to a scene that `plan` takes: the file, its start, and what the command says."""

import re
import sys

import ezdxf
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.cli import app
from wholearm_jax.files import load_start
from wholearm_jax.planning import flush_sides, touching_contacts


@pytest.fixture
def box(tmp_path, monkeypatch):
    """A drawing of a box 60 x 40 mm, and one of two discs, in the folder where the command runs."""
    monkeypatch.chdir(tmp_path)
    for name, draw in {
        "box": lambda msp: msp.add_lwpolyline([(0, 0), (60, 0), (60, 40), (0, 40)], close=True),
        "discs": lambda msp: [msp.add_circle((90 * k, 0), 10 + k) for k in (0, 1)],
        "ring": lambda msp: [msp.add_circle((0, 0), radius) for radius in (10, 20)],
    }.items():
        document = ezdxf.new()
        document.header["$INSUNITS"] = 4
        draw(document.modelspace())
        document.saveas(tmp_path / f"{name}.dxf")
    return tmp_path


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["wholearm", "scene", *arguments])
    with pytest.raises(SystemExit) as ended:
        app.main()
    return ended.value.code


def test_a_box_from_a_drawing_rests_flush_on_the_palm(box, monkeypatch, capsys):
    assert command(monkeypatch, "box.dxf", "--mass", "0.1", "--friction", "0.2") == 0
    said = capsys.readouterr().out
    assert "60 mm wide, 40 mm high, on edge 0" in said
    assert "hand: joints 78 mm apart, 1.3 times its width; fingers 110 mm long, 1.1 times" in said
    assert "wholearm plan box.toml" in said
    scene = load_start("box.toml")
    assert flush_sides(scene, touching_contacts(scene, scene.start)) == ("e0 on palm",)
    assert {"finger1:v2", "finger2:v3"} <= {*touching_contacts(scene, scene.start)}
    np.testing.assert_allclose(np.asarray(scene.start[:3]), [0.0, 0.02, 0.0], atol=1e-12)
    assert float(scene.object.mass) == 0.1
    assert np.asarray(scene.object.friction).tolist() == [0.2, 0.2, 0.2]
    assert scene.phases == ()
    made = wa.scene_from_outline(wa.read_outline("box.dxf"), mass=0.1, friction=0.2)
    np.testing.assert_array_equal(np.asarray(made.start), np.asarray(scene.start))


def test_a_part_with_curves_may_have_fewer_vertices(box, monkeypatch, capsys):
    """A rounded corner is many vertices, which a plan passes one after the other; with the tolerance named they go."""
    corner = [(0, 0, 0), (60, 0, 0), (60, 25, np.tan(np.pi / 8)), (45, 40, 0), (0, 40, 0)]
    document = ezdxf.new()
    document.header["$INSUNITS"] = 4
    document.modelspace().add_lwpolyline(corner, format="xyb", close=True)
    document.saveas("rounded.dxf")
    assert command(monkeypatch, "rounded.dxf") == 0
    out, err = capsys.readouterr()
    many, few = (int(word) for word in re.search(r"(\d+) vertices, (\d+) with --tolerance 0.5", err).groups())
    assert f", {many} vertices" in out
    assert command(monkeypatch, "rounded.dxf", "--tolerance", "0.5", "--out", "coarse.toml") == 0
    out, err = capsys.readouterr()
    assert f", {few} vertices" in out
    assert "--tolerance" not in err
    assert few < 0.7 * many


def test_each_link_has_its_friction(box, monkeypatch, capsys):
    assert command(monkeypatch, "box.dxf", "--friction", "palm=0.5,finger1=0.2,finger2=0.1") == 0
    assert "friction: palm=0.5,finger1=0.2,finger2=0.1" in capsys.readouterr().out
    assert np.asarray(load_start("box.toml").object.friction).tolist() == [0.5, 0.2, 0.1]


def test_a_box_stands_on_the_side_that_is_asked_for(box, monkeypatch, capsys):
    assert command(monkeypatch, "box.dxf", "--on", "e1") == 0
    assert "40 mm wide, 60 mm high, on edge 1" in capsys.readouterr().out
    scene = load_start("box.toml")
    assert flush_sides(scene, touching_contacts(scene, scene.start)) == ("e1 on palm",)
    np.testing.assert_allclose(np.asarray(scene.start[:3]), [0.0, 0.03, -np.pi / 2], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["discs.dxf"], "wholearm: discs.dxf: 2 outlines; choose one with --outline 1 to 2"),
        (["discs.dxf", "--outline", "3"], "wholearm: discs.dxf: outline 3: there are outlines 1 to 2"),
        (["ring.dxf"], "wholearm: ring.dxf: the outline has 1 hole; --fill-holes accepts it"),
        (["box.dxf", "--mass", "1", "--density", "1"], "wholearm: box.dxf: give mass or density, not both"),
        (["box.dxf", "--mass", "-1"], "wholearm: box.dxf: mass: must be positive, not -1"),
        (["box.dxf", "--on", "e4"], "wholearm: box.dxf: e4: the outline's edges are e0 to e3"),
        (["box.dxf", "--friction", "much"], "wholearm: --friction much: write a number, or palm=0.5"),
        (["box.dxf", "--friction", "palm=0.5"], "wholearm: box.dxf: friction: give one number, or one for each of"),
        (["box.dxf", "--unit", "parsec"], "wholearm: box.dxf: unit 'parsec' is not known"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line(box, monkeypatch, capsys, arguments, message):
    assert command(monkeypatch, *arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(message)
    assert said.count("\n") == 1
    assert not list(box.glob("*.toml"))


def test_outlines_are_listed_to_choose_from(box, monkeypatch, capsys):
    assert command(monkeypatch, "discs.dxf") == 2
    assert "area mm^2" in capsys.readouterr().out
    assert command(monkeypatch, "discs.dxf", "--outline", "2", "--out", "disc.toml") == 0
    assert np.ptp(np.asarray(load_start("disc.toml").object.vertices), axis=0) == pytest.approx(0.02, abs=1e-4)


def test_a_scene_that_is_there_already_stays(box, monkeypatch, capsys):
    (box / "box.toml").write_text("mine")
    assert command(monkeypatch, "box.dxf") == 2
    assert "box.toml: there already" in capsys.readouterr().err
    assert command(monkeypatch, "ring.dxf", "--fill-holes", "--out", "box.toml") == 0
    scene = load_start("box.toml")
    assert float(scene.object.mass) == pytest.approx(40 * np.pi * (0.02**2 - 0.01**2), rel=5e-3)
