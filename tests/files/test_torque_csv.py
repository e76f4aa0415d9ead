"""Torque schedules in CSV files: an exact round trip, tables from elsewhere, bad ones named by line."""

from pathlib import Path

import numpy as np
import pytest

from wholearm_jax.core.errors import SceneError
from wholearm_jax.files.results import write_torque
from wholearm_jax.files.torque_csv import read_torque
from wholearm_jax.model.schedule import torque_schedule

CASES = Path(__file__).parents[1] / "data" / "cases"


def test_torque_round_trip_is_exact(tmp_path):
    values = np.random.default_rng(0).normal(size=(6, 2))
    schedule = torque_schedule([0.0, 0.1, 1 / 3, 1 / 3, 2.0, 1e3 / 7], values)
    path = tmp_path / "torque.csv"
    write_torque(schedule, path)
    assert path.read_text().splitlines()[0] == "t,tau1,tau2"
    again = read_torque(path)
    np.testing.assert_array_equal(again.times, schedule.times)
    np.testing.assert_array_equal(again.values, values)


@pytest.mark.parametrize(
    "text",
    [
        "t,tau1,tau2\r\n0,1,2\r\n1,3,4\r\n",
        "\ufefft,tau1,tau2\n0,1,2\n1,3,4\n",
        "tau2, t ,note,tau1\n2,0,a,1\n\n4,1,b,3\n",
    ],
    ids=["carriage returns", "byte order mark", "other columns and blank lines"],
)
def test_torque_files_from_elsewhere(text, tmp_path):
    path = tmp_path / "torque.csv"
    path.write_bytes(text.encode())
    schedule = read_torque(path)
    np.testing.assert_array_equal(schedule.times, [0, 1])
    np.testing.assert_array_equal(schedule.values, [[1, 2], [3, 4]])


BAD_TORQUE = {
    "empty": ("", "line 1: the file is empty"),
    "header only": ("t,tau1,tau2\n", "line 1: the file ends here: a torque schedule needs at least two rows"),
    "one row": ("t,tau1,tau2\n0,1,2\n", "line 2: the file ends here: a torque schedule needs at least two rows"),
    "no header": ("0,0,0\n1,0,0\n", "line 1: missing column t, tau1, tau2"),
    "missing column": ("t,tau1\n0,0\n1,0\n", "line 1: missing column tau2"),
    "not sorted": ("t,tau1,tau2\n0,0,0\n1,0,0\n0.5,0,0\n", "line 4: t = 0.5 follows 1: times must not decrease"),
    "three times": ("t,tau1,tau2\n0,0,0\n1,0,0\n1,1,0\n1,2,0\n2,0,0\n", "line 5: t = 1 stands a third time"),
    "not a number": ("t,tau1,tau2\n0,0,0\n1,much,0\n", "line 3: not three numbers: '1,much,0'"),
    "short row": ("t,tau1,tau2\n0,0\n1,0,0\n", "line 2: not three numbers: '0,0'"),
    "empty cell": ("t,tau1,tau2\n0,,0\n1,0,0\n", "line 2: not three numbers: '0,,0'"),
    "two lines in one cell": ('t,tau1,tau2\n0,"a\nb",0\n1,0,0\n', "line 2: not three numbers"),
    "NaN": ("t,tau1,tau2\n0,0,0\n1,nan,0\n", "line 3: not finite: '1,nan,0'"),
    "infinity": ("t,tau1,tau2\n0,0,0\n1,0,-inf\n", "line 3: not finite: '1,0,-inf'"),
    "infinite time": ("t,tau1,tau2\n0,0,0\n1e999,0,0\n", "line 3: not finite: '1e999,0,0'"),
}


@pytest.mark.parametrize(("text", "cause"), BAD_TORQUE.values(), ids=BAD_TORQUE.keys())
def test_bad_torque_files_are_named_by_line(text, cause, tmp_path):
    path = tmp_path / "torque.csv"
    path.write_text(text)
    with pytest.raises(SceneError) as caught:
        read_torque(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: {cause}")
    assert "\n" not in message


@pytest.mark.parametrize("kind", ["missing", "folder", "binary"])
def test_unreadable_torque_files(kind, tmp_path):
    path = tmp_path / "torque.csv"
    if kind == "folder":
        path.mkdir()
    if kind == "binary":
        path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(SceneError, match="no such file" if kind == "missing" else "cannot be read"):
        read_torque(path)


# --- tables from elsewhere -------------------------------------------------------------------------------------------

ONCE = {
    "semicolons": "t;tau1;tau2\n0;1;2\n0.5;3;4\n",
    "decimal commas": "\ufefft;tau1;tau2\r\n0,0;1,0;2\r\n0,5;3,0;4\r\n",
    "decimal commas in quotes": 't,tau1,tau2\n"0,0","1,0",2\n"0,5","3,0",4\n',
    "tabs": "t\ttau1\ttau2\n0\t1\t2\n0,5\t3\t4\n",
    "bars": "t | tau1 | tau2\n0 | 1 | 2\n0.5 | 3 | 4\n",
    "spaces": "t tau1 tau2\n0   1  2\n 0.5  3  4\n",
    "a comment as the header": "# t tau1 tau2\n0 1 2\n0.5 3 4\n",
    "comments above": "# made elsewhere\n# in 2026\nt,tau1,tau2\n0,1,2\n0.5,3,4\n",
    "the separator named": "sep=;\r\nt;tau1;tau2\r\n0;1;2\r\n0,5;3;4\r\n",
    "units": "t [s],tau1 [Nm],tau2 [N m]\n0,1,2\n0.5,3,4\n",
    "units in parentheses": "t (s);tau1 (N m);tau2 (N*m)\n0;1;2\n0.5;3;4\n",
    "units behind strokes": "t/s,tau1/Nm,tau2 / N\u00b7m\n0,1,2\n0.5,3,4\n",
    "other units": "t [ms],tau1 [mNm],tau2 [N cm]\n0,1000,200\n500,3000,400\n",
    "trailing separators": "t,tau1,tau2,,\n0,1,2,,\n0.5,3,4,,\n",
    "trailing separators below the header": "t;tau1;tau2\n0;1;2;\n0.5;3;4;\n",
    "blank lines": "\n  \nt,tau1,tau2\n\n0,1,2\n   \n0.5,3,4\n,,\n\t\n\n",
    "an index": ",t,tau1,tau2\n0,0,1,2\n1,0.5,3,4\n",
    "comments below": "t,tau1,tau2\n0,1,2\n# half way\n0.5,3,4\n# made elsewhere\n",
    "carriage returns alone": "t,tau1,tau2\r0,1,2\r0.5,3,4\r",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("text", ONCE.values(), ids=ONCE.keys())
def test_tables_that_can_be_read_in_one_way(text, encoding, tmp_path):
    path = tmp_path / "torque.csv"
    if encoding == "utf-16":
        text = text.removeprefix("\ufeff").replace("\u00b7", "")
    path.write_bytes(text.encode(encoding))
    schedule = read_torque(path)
    np.testing.assert_array_equal(schedule.times, [0, 0.5])
    np.testing.assert_allclose(schedule.values, [[1, 2], [3, 4]], rtol=1e-15)


def test_a_minus_of_typesetting_and_a_code_page_are_read(tmp_path):
    path = tmp_path / "torque.csv"
    path.write_bytes("t [s],tau1 [N\u00b7m],tau2 [N\u00b7m]\n0,1,-2\n0.5,3,-4\n".encode("cp1252"))
    expected = read_torque(path).values
    path.write_text("t,tau1,tau2\n0,1,\u22122\n0.5,3,\u22124\n", encoding="utf-8")
    np.testing.assert_array_equal(read_torque(path).values, expected)
    np.testing.assert_array_equal(expected, [[1, -2], [3, -4]])


def test_wide_characters_without_a_mark_are_refused(tmp_path):
    path = tmp_path / "torque.csv"
    path.write_bytes("t,tau1,tau2\n0,1,2\n1,3,4\n".encode("utf-16-le"))
    with pytest.raises(SceneError, match="cannot be read: not text in UTF-8"):
        read_torque(path)


REFUSED = {
    "a doubled column": ("t,tau1,tau2,tau1\n0,1,2,0\n1,3,4,0\n", "line 1: column tau1 stands twice"),
    "doubled but for its unit": ("t;tau1 [Nm];tau2;tau1\n0;1;2;0\n1;3;4;0\n", "line 1: column tau1 stands twice"),
    "another name": (
        "time;tau1;tau2\n0;1;2\n",
        "line 1: missing column t; the header found is 'time;tau1;tau2' (split at ';'); wanted is the header",
    ),
    "one column": ("hello\n1\n", "line 1: missing column t, tau1, tau2; the header found is 'hello' (no separator"),
    "an unknown unit": ("t [h],tau1,tau2\n0,1,2\n", "line 1: column t: unknown unit [h]; known: s"),
    "an unknown torque": ("t,tau1 [%],tau2\n0,1,2\n", "line 1: column tau1: unknown unit [%]; known: Nm"),
    "decimal commas between commas": ("t,tau1,tau2\n0,0,0,88,-0,76\n", "line 2: 6 values under 3 columns separated by"),
    "commas and points": ("t;tau1;tau2\n0;0.5;1\n1;0,5;1\n", "line 3: commas and points in numbers"),
    "thousands": ("t;tau1;tau2\n0;1;1\n1;1,000;1\n", "line 3: the comma may be decimal or part thousands"),
    "another separator below": ("t,tau1,tau2\n0;1;2\n", "line 2: not three numbers: '0;1;2'; it is separated by ';'"),
    "underscores": ("t,tau1,tau2\n0,1_0,2\n1,1,1\n", "line 2: not three numbers"),
    "another separator named": (
        "sep=;\nt,tau1,tau2\n0,1,2\n",
        "line 2: missing column t, tau1, tau2; the header found",
    ),
    "a value without a column": ("t,tau1,tau2\n0,1,2,3\n1,1,1\n", "line 2: 4 values under 3 columns"),
}


@pytest.mark.parametrize(("text", "cause"), REFUSED.values(), ids=REFUSED.keys())
def test_tables_that_could_mean_two_things_are_refused(text, cause, tmp_path):
    path = tmp_path / "torque.csv"
    path.write_text(text)
    with pytest.raises(SceneError) as caught:
        read_torque(path)
    assert str(caught.value).startswith(f"{path}: {cause}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["semicolon", "excel_de", "header_units", "blank_tail"])
def test_cases_of_schedules_that_are_read(name):
    schedule = read_torque(CASES / f"torque_{name}.csv")
    assert schedule.values[0].tolist() == [0.8798804145159488, -0.7601156022552831]
    assert float(schedule.times[-1]) == 2.0


def test_the_case_of_a_doubled_column_is_refused():
    with pytest.raises(SceneError, match="line 1: column tau1 stands twice"):
        read_torque(CASES / "torque_dup_header.csv")
