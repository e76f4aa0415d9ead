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
    from rich.measure import Measurement
    from rich.table import Table

    width = terminal_width()
    console = Console(width=width, highlight=False, markup=False, emoji=False)
    table = Table()
    for column in columns:
        table.add_column(column.name, justify="right" if column.is_number else "left")
    for row in rows:
        table.add_row(*row)
    if title:
        print(textwrap.fill(title, width))
    if rows and Measurement.get(console, console.options.update(max_width=10 * width), table).minimum <= width:
        console.print(table)
    else:
        _print_stacked(columns, rows, width)
    for line in legend.splitlines():
        print(textwrap.fill(line, width, subsequent_indent="  "))


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
