"""`wholearm report`: the page of a result folder."""

from pathlib import Path
from typing import Annotated

import typer

from wholearm_jax.cli.arguments import refuse_unwritable
from wholearm_jax.cli.output import write_report


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that optimise, simulate or search wrote.")],
    out: Annotated[Path | None, typer.Option(help="The page to write; report.html in the folder unless given.")] = None,
) -> None:
    """Write a result folder's report, a page for any browser.

    It has an animation, plots and tables, and needs no network.
    """
    path = out or folder / "report.html"
    with refuse_unwritable(str(path)):
        write_report(folder, path)
    print(path)
