"""Places at which the planner may leave a move: where the goal is met, at its end, and where others may begin."""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from wholearm_jax.model import COORDINATES
from wholearm_jax.planning.goal import Goal
from wholearm_jax.planning.moves import Move
from wholearm_jax.planning.plans import Step, leading_coordinate

STOPS = {  # fractions of a path at which other moves may begin, and by how many phases later they are tried
    **dict.fromkeys((1 / 3, 2 / 3), 0.0),
    **dict.fromkeys((1 / 6, 1 / 2, 5 / 6), 1.0),
    **dict.fromkeys((1 / 12, 1 / 4, 5 / 12, 7 / 12, 3 / 4, 11 / 12), 2.0),
}
AT_TIP = 3.0  # by how many phases later an arrival is taken at which a contact leaves its feature, as at a tip


def move_stops(move: Move, goal: Goal, unit: Float[np.ndarray, "5"]) -> Iterator[tuple[Step, bool]]:
    """Yield the places at which a move may be left: the goal's coordinates, its end, and a few between.

    Each comes with whether it is the end. `unit` is that of the coordinates.

    Of two that reach the goal the search takes the first: where a path meets the goal itself, not its end nearby.
    """
    lowest = np.minimum.accumulate(move.margins)
    last = len(move.places) - 1
    for name, value in goal.values.items():
        yield from _crossings(move, lowest, name, value)
    end = move.places[last]
    delay = AT_TIP if move.leaves and goal.is_reached(end) else 0.0
    yield Step(move.contacts, move.toward, None, end, float(lowest[last]), leaves=move.leaves, delay=delay), True
    name = leading_coordinate(move.places[last] - move.places[0], unit)
    stops = {round(fraction * last): delay for fraction, delay in STOPS.items()}
    if move.leaves:  # a hand that is to go on with the contact stops before its feature's end
        stops[move.secure] = 0.0
    for place, delay in stops.items():
        value = float(move.places[place][COORDINATES.index(name)])
        for step, is_end in itertools.islice(_crossings(move, lowest, name, value), 1):
            yield replace(step, delay=delay), is_end


def _crossings(move: Move, lowest: np.ndarray, name: str, value: float) -> Iterator[tuple[Step, bool]]:
    """Yield the places of a move at which a coordinate first has a value, strictly between its ends."""
    row = COORDINATES.index(name)
    off = move.places[:, row] - value
    crossed = np.flatnonzero((off[:-1] != 0) & (off[:-1] * off[1:] <= 0))
    if len(crossed) and crossed[0] + 1 < len(off):
        k = int(crossed[0])
        fraction = off[k] / (off[k] - off[k + 1])
        z = move.places[k] + fraction * (move.places[k + 1] - move.places[k])
        if 0 < k + fraction < len(off) - 1 - 1e-6:
            yield Step(move.contacts, move.toward, (name, value), z, float(lowest[k + 1])), False
