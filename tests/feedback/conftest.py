"""What tests of feedback share: a plan, and a law for it."""

import pytest

import wholearm_jax as wa


@pytest.fixture(scope="session")
def scene():
    return wa.load("heptagon")


@pytest.fixture(scope="session")
def controller(scene):
    return wa.feedback(scene, wa.quasistatic(scene), friction=0.2)
