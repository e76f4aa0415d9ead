"""A drawing of a box 60 x 40 mm, turned by 90 degrees on a hand that is searched for: the commands of the README."""

import json
import sys

import ezdxf
import pytest

from wholearm_jax.cli import app

COMMANDS = (
    "scene box.dxf --on e1 --mass 0.2 --friction palm=0.5,finger1=0.1,finger2=0.1",
    "plan box.toml --by phi=-90deg --hand-from length=0.10:0.10,joint=0.045:0.045 --count 1 --out plan",
    "optimise plan/plan.toml --feedback --robust friction=10% --out law",
    "execute plan/plan.toml --controller law/controller.json --out execution",
)


def test_a_box_from_a_drawing_is_turned_by_90_degrees(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    document = ezdxf.new()
    document.header["$INSUNITS"] = 4
    document.modelspace().add_lwpolyline([(0, 0), (60, 0), (60, 40), (0, 40)], close=True)
    document.saveas("box.dxf")
    for command in COMMANDS:
        monkeypatch.setattr(sys, "argv", ["wholearm", *command.split()])
        with pytest.raises(SystemExit) as ended:
            app.main()
        assert ended.value.code == 0, capsys.readouterr().err
    said = json.loads((tmp_path / "execution" / "execution.json").read_text())
    assert said["status"] == "ok"
