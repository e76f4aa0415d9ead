"""Torque schedules from CSV files, also of spreadsheets and other programs, where they can be read in one way only.

Separators may be commas, semicolons, tabs, bars or spaces; decimals may be commas where the separator is not. Units in
the header, a byte-order mark, blank lines, comments (`#`) and trailing separators are read. What could mean two things
is refused.
"""

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wholearm_jax.core import SceneError
from wholearm_jax.model import TorqueSchedule, torque_schedule

TORQUE_COLUMNS = ("t", "tau1", "tau2")
SEPARATORS = {",": "','", ";": "';'", "\t": "tabs", "|": "'|'", " ": "spaces"}
WANTED_HEADER = "wanted is the header t,tau1,tau2 (s, N m), separated by ','"
# Units that a header may give, as factors to s and N m. Spaces, points, asterisks and hyphens within them do not count.
TIME_UNITS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6}
TORQUE_UNITS = {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2}
_HEADER_CELL = re.compile(r"(?P<name>[^\[\](/]+?)\s*(\[(?P<a>.*)\]|\((?P<b>.*)\)|/\s*(?P<c>.+))?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")


@dataclass(frozen=True)
class _Table:
    """Lines of a file below its header: `(number of the line, cells)`; `places` and `factors` of the three columns."""

    separator: str
    header: list[str]
    rows: list[tuple[int, list[str]]]
    places: list[int]
    factors: list[float]
    last_line: int


def read_torque(path: str | Path) -> TorqueSchedule:
    """Read a torque schedule from a CSV file.

    Its header is `t,tau1,tau2` (s, N m), in any order and among other columns. It may give units (`t [ms]`, `tau1 (N
    m)`); the separator may be a semicolon, with decimal commas then, a tab, a bar or spaces.

    Args:
        path: The file.

    Returns:
        The schedule, linear between rows; a repeated time is a step.

    Raises:
        SceneError: For a file that cannot be read in one way only, naming the file, the line and the cause.

    >>> wa.write_torque(wa.torque_schedule([0.0, 2.0], [[0.5, -0.2], [0.5, -0.4]]), folder / "torque.csv")
    >>> wa.read_torque(folder / "torque.csv").values.tolist()
    [[0.5, -0.2], [0.5, -0.4]]
    """
    try:
        table = _read_table(_read_text(path))
        rows = _read_numbers(table)
    except ValueError as error:
        raise SceneError(f"{path}: {error}") from None
    numbers = np.asarray(rows).reshape(-1, len(TORQUE_COLUMNS))
    try:
        return torque_schedule(numbers[:, 0], numbers[:, 1:])
    except ValueError as error:
        raise SceneError(f"{path}: line {table.last_line}: the file ends here: {error}") from None


def _read_text(path: str | Path) -> str:
    """Read a file as UTF-8, as the UTF-16 that spreadsheets write as "Unicode text", or in Windows' code page.

    In a code page only words and units of the header can be misread, which the columns' names then show.
    """
    try:
        content = Path(path).read_bytes()
        if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return _plain(content.decode("utf-16"))
        try:
            return _plain(content.decode("utf-8-sig"))
        except UnicodeDecodeError:
            return _plain(content.decode("cp1252"))
    except FileNotFoundError:
        raise ValueError("no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def _plain(text: str) -> str:
    """Return a text as it is. Raises ValueError for one that another encoding has made of something else."""
    if "\0" in text or (text.strip() and not re.search("[ -~]", text)):
        raise ValueError("cannot be read: not text in UTF-8")
    return text


def _read_table(text: str) -> _Table:
    """Find the header, the separator and the three columns. Raises ValueError."""
    lines = re.split(r"\r\n|\r|\n", text.rstrip())
    number = next((k for k, line in enumerate(lines) if line.strip()), None)
    if number is None:
        raise ValueError("line 1: the file is empty; it needs the header t,tau1,tau2 and at least two rows")
    separators = tuple(SEPARATORS)
    hint = re.fullmatch(r'"?sep=(.)"?\s*', lines[number])  # a spreadsheet's own
    if hint is not None and number + 1 < len(lines):
        number, separators = number + 1, (hint[1],)
    while True:
        head = lines[number].lstrip("# ").strip()
        candidates = {separator: _split([head], separator)[0] for separator in separators}
        separator = next((s for s, cells in candidates.items() if not _missing(cells)), None)
        if separator is not None or not lines[number].startswith("#") or number + 1 == len(lines):
            break
        number += 1  # a comment above the header
    if separator is None:
        named = {s: (len(TORQUE_COLUMNS) - len(_missing(cells)), _count(cells)) for s, cells in candidates.items()}
        guess = max(named, key=lambda s: named[s])
        raise ValueError(f"line {number + 1}: {_why_not(candidates[guess], head, guess)}")
    header = candidates[separator]
    parsed = [_column(cell) for cell in header]
    names = [name for name, _ in parsed]
    twice = next((name for k, name in enumerate(names) if name and name in names[:k]), None)
    if twice is not None:
        raise ValueError(f"line {number + 1}: column {twice} stands twice in the header {head!r:.80}; {WANTED_HEADER}")
    places = [names.index(name) for name in TORQUE_COLUMNS]
    factors = [_factor(*parsed[place], number + 1) for place in places]
    body = _split(lines[number + 1 :], separator)
    rows = [(number + 2 + k, cells) for k, cells in enumerate(body) if _count(cells) and cells[0].lstrip()[:1] != "#"]
    return _Table(separator, header, rows, places, factors, len(lines))


def _split(lines: list[str], separator: str) -> list[list[str]]:
    """Split lines into cells, each line by itself; a quoted cell may hold the separator."""
    if separator == " ":
        return [line.split() for line in lines]
    try:
        return [next(csv.reader([line], delimiter=separator), []) for line in lines]
    except csv.Error as error:
        raise ValueError(f"cannot be read: {error}") from None


def _column(cell: str) -> tuple[str, str | None]:
    """Split a header's cell into the column's name and its unit, if it gives one."""
    match = _HEADER_CELL.fullmatch(cell.strip())
    if match is None:
        return cell.strip(), None
    unit = next((match[group] for group in "abc" if match[group] is not None), None)
    return match["name"].strip(), unit


def _missing(cells: list[str]) -> list[str]:
    names = [_column(cell)[0] for cell in cells]
    return [name for name in TORQUE_COLUMNS if name not in names]


def _count(cells: list[str]) -> int:
    return sum(1 for cell in cells if cell.strip())


def _why_not(cells: list[str], head: str, separator: str) -> str:
    """Say what a header lacks: what was found, how it was split, and what is wanted."""
    split = f"split at {SEPARATORS.get(separator, repr(separator))}" if _count(cells) > 1 else "no separator found"
    return f"missing column {', '.join(_missing(cells))}; the header found is {head!r:.80} ({split}); {WANTED_HEADER}"


def _factor(name: str, unit: str | None, line: int) -> float:
    """Return the factor that turns a column's unit into s or N m. Raises ValueError for an unknown unit."""
    if unit is None:
        return 1.0
    known = TIME_UNITS if name == "t" else TORQUE_UNITS
    factor = known.get(re.sub(r"[\s.*·⋅-]", "", unit))
    if factor is None:
        raise ValueError(f"line {line}: column {name}: unknown unit [{unit:.20}]; known: {', '.join(known)}")
    return factor


def _read_numbers(table: _Table) -> list[list[float]]:
    """Read the rows in order: finite numbers, times that do not decrease. Raises ValueError naming the line."""
    comma = _has_decimal_commas(table)
    rows: list[list[float]] = []
    for line, cells in table.rows:
        shown = repr(table.separator.join(cells))[:60]
        if any(cell.strip() for cell in cells[len(table.header) :]):
            count = f"{_count(cells)} values under {_count(table.header)} columns separated by"
            raise ValueError(f"line {line}: {count} {SEPARATORS.get(table.separator, table.separator)}: {shown}")
        try:
            texts = [cells[place].strip() for place in table.places]
            values = [_number(text.replace(",", ".") if comma else text) for text in texts]
        except (ValueError, IndexError):
            raise ValueError(f"line {line}: not three numbers: {shown}{_other_separator(table, cells)}") from None
        if not all(map(math.isfinite, values)):
            raise ValueError(f"line {line}: not finite: {shown}")
        values = [value * factor for value, factor in zip(values, table.factors, strict=True)]
        if rows and values[0] < rows[-1][0]:
            raise ValueError(f"line {line}: t = {values[0]:g} follows {rows[-1][0]:g}: times must not decrease")
        if len(rows) > 1 and values[0] == rows[-2][0]:
            raise ValueError(f"line {line}: t = {values[0]:g} stands a third time; twice is a step")
        rows.append(values)
    return rows


def _number(text: str) -> float:
    if "_" in text:  # which Python allows between digits
        raise ValueError
    return float(text.replace("\u2212", "-"))  # the minus sign of typesetting


def _other_separator(table: _Table, cells: list[str]) -> str:
    """Say that a line is separated otherwise than the header, where it is."""
    other = next((s for s in SEPARATORS if _count(cells) == 1 and len(_split(cells, s)[0]) >= len(table.places)), None)
    if other is None:
        return ""
    return f"; it is separated by {SEPARATORS[other]}, the header by {SEPARATORS.get(table.separator, table.separator)}"


def _has_decimal_commas(table: _Table) -> bool:
    """Say whether numbers are written with decimal commas. Raises ValueError where that cannot be told."""
    points = commas = None
    ambiguous = True
    for line, cells in table.rows:
        for text in (cells[place].strip() for place in table.places if place < len(cells)):
            points = points or (line if "." in text else None)
            if "," in text:
                commas = commas or line
                ambiguous &= _THOUSANDS.fullmatch(text) is not None
    if commas and points:
        raise ValueError(f"line {max(commas, points)}: commas and points in numbers: which are decimal cannot be told")
    if commas and ambiguous:
        raise ValueError(f"line {commas}: the comma may be decimal or part thousands; write points")
    return commas is not None
