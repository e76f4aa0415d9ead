"""`wholearm tradeoff`: margin against duration."""

import json

import numpy as np
from support import layered_file


def test_less_margin_takes_less_time(wholearm, tmp_path):
    code, out, err = wholearm("tradeoff", layered_file("hexagon"), "--json", "--out", tmp_path)
    assert (code, err) == (0, "")
    answer = json.loads(out)
    rows = answer["tradeoff"]
    for phase, largest in answer["largest"].items():
        margins, seconds = [row["margin"] for row in rows], [row["durations"][phase] for row in rows]
        assert 0 == margins[0] < margins[-1] < largest
        assert np.all(np.diff(margins) > 0)
        assert np.all(np.diff(seconds) >= 0)
        assert seconds[0] > 0.05
        assert seconds[-1] < 2.0
    assert all(row["total"] == sum(row["durations"].values()) for row in rows)
    assert {f"tradeoff.{kind}" for kind in ("png", "svg", "pdf")} == {path.name for path in tmp_path.iterdir()}


def test_the_table_has_a_row_a_margin(wholearm):
    code, out, _ = wholearm("tradeoff", layered_file("hexagon"))
    assert code == 0
    assert "shortest durations" in out
    assert "total s" in out
