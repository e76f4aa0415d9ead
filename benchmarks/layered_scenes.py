"""Plans of hands whose fingers pass each other, in planes of their own: earlier results are of these."""

from pathlib import Path

import wholearm_jax as wa


def layered_file(name: str) -> Path:
    """The scene file of `heptagon`, `hexagon`, `tipping`, `flight` or `passage`."""
    return Path(__file__).parent / "scenes" / f"{name}_layered.toml"


def layered(name: str) -> wa.Scene:
    """The scene in that file."""
    return wa.load(layered_file(name))
