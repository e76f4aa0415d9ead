"""What the commands have in common: their arguments, and what is said of those that cannot be used."""

from pathlib import Path
from typing import Annotated

import typer

SceneName = Annotated[str, typer.Argument(help="A bundled scene's name, or the path of a scene file.")]
TorqueFile = Annotated[Path, typer.Option("--torque", help="Torque schedule, CSV with the header t,tau1,tau2.")]


class BadInput(Exception):
    """What the user gave cannot be used; the message is one line."""
