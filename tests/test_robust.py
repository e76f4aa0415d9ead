"""A schedule for a sample of scenes does better on scenes that it has not seen than one for the nominal scene."""

from pathlib import Path

import equinox as eqx
import pytest

import wholearm_jax as wa
from wholearm_jax.robust import optimise_robustly
from wholearm_jax.variation import vary


@pytest.fixture(scope="module")
def found():
    plan = wa.load("heptagon")
    slide = eqx.tree_at(lambda s: s.phases, plan, plan.phases[:1])
    both = wa.read_torque(Path(__file__).parent / "data" / "heptagon_torque.csv")
    nominal = wa.torque(both.times[:51], both.values[:51])
    return optimise_robustly(
        vary(slide, {"friction": "20%"}, seed=1), samples=12, steps=40, arrival=0.02, nominal=nominal
    )


def test_more_of_the_unseen_scenes_hold(found):
    nominal, robust = found.unseen
    assert nominal.share < 0.7 < 0.9 < robust.share


def test_the_worst_margin_of_unseen_scenes_is_larger(found):
    nominal, robust = found.unseen
    assert robust.margin > nominal.margin + 0.02


def test_the_best_on_the_samples_is_kept(found):
    nominal, robust = found.seen
    assert (robust.share, robust.margin) > (nominal.share, nominal.margin)
