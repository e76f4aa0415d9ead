"""Tables and JSON on standard output."""

import json
import shutil
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

PIPE_WIDTH = 120  # columns of a table that no terminal shows


class Column(NamedTuple):
    """A column's heading, and whether it holds numbers, which are set to the right."""

    name: str
    is_number: bool = False


def print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]], title: str = "", legend: str = "") -> None:
    """Print a table that fits the terminal: with wrapped cells, or with the cells of a row below one another.

    Args:
        columns: headings.
        rows: cells, a text for each column.
        title: a line above the table.
        legend: lines below it.
    """
    from rich.console import Console
    from rich.table import Table

    width = terminal_width()
    for line in title.splitlines():
        print(textwrap.fill(line, width, subsequent_indent="  "))
    widths = _column_widths(columns, rows, width)
    if widths is None:
        _print_stacked(columns, rows, width)
    else:
        table = Table()
        for column, fixed in zip(columns, widths, strict=True):
            table.add_column(column.name, justify="right" if column.is_number else "left", width=fixed)
        for row in rows:
            table.add_row(*row)
        Console(width=width, highlight=False, markup=False, emoji=False).print(table)
    for line in legend.splitlines():
        print(textwrap.fill(line, width, subsequent_indent="  "))


def _column_widths(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> list[int] | None:
    """Return the widths of columns that fit, the widest shrunk first; None if words or numbers would have to be cut."""
    cells = list(zip(*rows, strict=True)) if rows else [()] * len(columns)
    widths = [max(map(len, (column.name, *own))) for column, own in zip(columns, cells, strict=True)]
    least = []
    for column, own in zip(columns, cells, strict=True):
        words = [word for text in (column.name, *own) for word in text.split()]
        least.append(max(map(len, (*words, *(own if column.is_number else ()))), default=0))
    available = width - 3 * len(columns) - 1  # borders and padding
    if sum(least) > available:
        return None
    while sum(widths) > available:
        widest = max(range(len(widths)), key=lambda k: widths[k] if widths[k] > least[k] else -1)
        widths[widest] -= 1
    return widths


def _print_stacked(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> None:
    """Print each row as lines `heading: cell`, with a blank line after it."""
    for row in rows:
        for column, cell in zip(columns, row, strict=True):
            if cell:
                print(textwrap.fill(f"{column.name}: {cell}".strip(": "), width, subsequent_indent="  "))
        print()


def terminal_width() -> int:
    """Return the columns of the terminal, or of `COLUMNS`; `PIPE_WIDTH` without either."""
    return max(20, shutil.get_terminal_size((PIPE_WIDTH, 24)).columns)


def print_json(content: Any) -> None:
    """Print a JSON document; None stands for undefined numbers."""
    from wholearm_jax.files import null_for_undefined

    print(json.dumps(null_for_undefined(content), indent=2, allow_nan=False))
