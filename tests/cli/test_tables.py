"""Tables fit the terminal, and every command that prints one prints JSON on request."""

import json
from importlib.metadata import version

import pytest
from support import layered_file

from wholearm_jax.cli.tables import Column, print_json, print_table

COLUMNS = [Column("contacts"), Column("bound N", True), Column("leads to")]
ROWS = [("palm:v5 palm:v6 finger1:v1 finger2:v3", "0.966", "finger2:v4 is made"), ("finger1:v1 rolling", "-", "")]


@pytest.mark.parametrize("width", [20, 30, 40, 80, 200])
def test_a_table_fits_its_terminal(width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(width))
    print_table(COLUMNS, ROWS, "touching: palm:v5, palm:v6, finger1:v1, finger2:v3", "bound: the best least force")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    text = " ".join(" ".join(lines).replace("\u2502", " ").split())
    for word in ("0.966", "finger2:v4", "palm:v5", "rolling", "bound", "touching:"):
        assert word in text, "nothing is cut off"


def test_a_narrow_table_puts_cells_below_one_another(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "24")
    print_table(COLUMNS, ROWS)
    blocks = capsys.readouterr().out.split("\n\n")
    assert blocks[0].splitlines()[-2:] == ["bound N: 0.966", "leads to: finger2:v4 is"] or "bound N: 0.966" in blocks[0]
    assert blocks[1] == "contacts: finger1:v1\n  rolling\nbound N: -"


def test_json_has_no_undefined_numbers(capsys):
    print_json({"a": float("nan"), "b": [float("-inf"), 1.0]})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.0]}


def test_the_version(wholearm):
    code, out, err = wholearm("--version")
    assert (code, out, err) == (0, f"wholearm_jax {version('wholearm_jax')}\n", "")


def test_scenes_as_json(wholearm):
    code, out, _ = wholearm("scenes", "--json")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(out)}
    assert rows["heptagon"] == {
        "name": "heptagon",
        "title": "irregular heptagon",
        "phases": ["slide right", "flip right"],
    }


def test_a_simulation_as_json(wholearm, tmp_path):
    """Standard output is the summary, as in its file, whatever becomes of the plan."""
    torque = tmp_path / "zero.csv"
    torque.write_text("t,tau1,tau2\n0,0,0\n2,0,0\n")
    code, out, err = wholearm(
        "simulate", layered_file("heptagon"), "--torque", torque, "--json", "--out", tmp_path / "out"
    )
    assert (code, err) == (1, "")
    assert json.loads(out) == json.loads((tmp_path / "out" / "summary.json").read_text())
