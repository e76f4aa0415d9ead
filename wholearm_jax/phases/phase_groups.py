"""Which phases begin at rest, and which follow one another at speed."""

from wholearm_jax.model import Arrival, Scene


def starts_at_rest(scene: Scene) -> list[bool]:
    """Say for each phase whether it starts at rest."""
    return [True, *(phase.arrive is not Arrival.MOVING for phase in scene.phases[:-1])]


def group_phases(scene: Scene) -> list[list[int]]:
    """Return the numbers of the phases in each group of those that follow one another at speed."""
    groups: list[list[int]] = []
    for index, at_rest in enumerate(starts_at_rest(scene)):
        groups = [*groups, [index]] if at_rest else [*groups[:-1], [*groups[-1], index]]
    return groups
