"""The command line: `wholearm`, whose commands are listed in the order in which a newcomer meets them.

Exit status 0 when the result is `ok`, 1 when the plan fails (its status is printed), 2 for bad input, in one line.
"""

import gc
import os
import sys
import warnings
from importlib import metadata
from typing import Annotated, Any

import typer

from wholearm_jax.cli.arguments import BadInput, note
from wholearm_jax.cli.check import check
from wholearm_jax.cli.execute import execute
from wholearm_jax.cli.formations import formations
from wholearm_jax.cli.interruption import INTERRUPTED, exit_on_interrupt
from wholearm_jax.cli.optimise import optimise
from wholearm_jax.cli.plan import plan
from wholearm_jax.cli.report import report
from wholearm_jax.cli.scene import scene
from wholearm_jax.cli.scenes import scenes
from wholearm_jax.cli.search import search
from wholearm_jax.cli.simulate import simulate
from wholearm_jax.cli.tradeoff import tradeoff
from wholearm_jax.core import DoubtfulInput, configure, discard_unreadable_entry, keep_compiled

UsageError: Any = typer.BadParameter.__mro__[1]  # of the library beneath, which Typer has under changing names

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def _print_version(requested: bool) -> bool:
    if requested:
        print(f"wholearm_jax {metadata.version('wholearm_jax')}")
        raise typer.Exit
    return requested


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version, and exit.")
    ] = False,
) -> None:
    """Dynamics and torque optimisation of planar whole-arm manipulation."""


for command in (scenes, scene, plan, formations, optimise, simulate, search, tradeoff, execute, check, report):
    app.command()(command)


def main() -> None:
    """Run the command line."""
    restore_interrupt = exit_on_interrupt()
    # BLAS threads cost more than they gain on small systems: they wait for one another, spinning.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("MPLBACKEND", "agg")
    # Tracing makes many objects, nearly all to stay: fewer garbage collections make a first run faster.
    gc.set_threshold(100_000, 20, 20)
    if sys.argv[1:2] != ["check"]:  # `check` configures itself by the number of its scenes
        configure()
    keep_compiled()
    _handle_warnings()
    try:
        sys.exit(app(sys.argv[1:] or ["--help"], standalone_mode=False) or 0)
    except typer.Abort:
        sys.exit(INTERRUPTED)
    except UsageError as error:
        print(f"wholearm: {error.format_message()}", file=sys.stderr)
        sys.exit(2)
    except BadInput as error:
        print(f"wholearm: {error}", file=sys.stderr)
        sys.exit(2)
    finally:
        restore_interrupt()


def _handle_warnings() -> None:
    """Print warnings about doubtful input as notes; discard a damaged file of its cache of which JAX warns."""
    show = warnings.showwarning

    def show_note(message, category, *others):
        if issubclass(category, DoubtfulInput):
            note(str(message))
        elif not discard_unreadable_entry(str(message)):
            show(message, category, *others)

    warnings.showwarning = show_note


if __name__ == "__main__":
    main()
