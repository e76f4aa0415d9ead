"""Where there is no plan, the margins that the reason names are those of a linear programme of the tests' own."""

import re

import numpy as np
import pytest

import wholearm_jax as wa
from tests.reference.slow_motion import largest_slack
from wholearm_jax.core import as_device_array
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.planning.moves import moves_from

CLAIM = re.compile(
    r"((?:\w+:\w+ (?:rolling )?)+)toward (\S+) has a margin of (-[\d.]+) N at (\d+) % of its path"
    r"(?:, first too little at (\d+) %)?"
)


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A box 60 x 40 mm at rest, on the hand that was chosen for it."""
    outline = tmp_path_factory.mktemp("drawing") / "box.csv"
    outline.write_text("x [mm],y [mm]\n0,0\n60,0\n60,40\n0,40\n")
    return wa.scene_from_outline(wa.read_outline(outline), mass=0.2)


@pytest.mark.parametrize("by", [{"phi": -1.4}, {"phi": 1.0}, {"x": -0.06}])
def test_the_margins_of_a_reason_are_right(box, by):
    found = wa.plan(box, by=by, max_nodes=20)
    assert not found.found
    claims = CLAIM.findall(found.reason)
    assert len(claims) == 3
    begin = found.start if found.nearest is None else found.nearest.ends[-1]
    moves = {(move.contacts, move.toward): move for move in moves_from(box, as_device_array(begin))}
    for text, toward, margin, percent, too_little in claims:
        names = tuple(re.findall(r"\w+:\w+(?: rolling)?", text))
        places = moves[names, toward].places
        velocities = np.gradient(places, axis=0, edge_order=2)

        def slack(k, places=places, velocities=velocities, names=names):
            return largest_slack(to_dict(box), places[k], velocities[k], names)

        k = round(float(percent) / 100 * (len(places) - 1))
        assert float(margin) == pytest.approx(slack(k), rel=5e-3)
        first = round(float(too_little) / 100 * (len(places) - 1)) if too_little else k
        assert all(slack(j) > 0 for j in range(first))
        assert slack(first) <= 0
