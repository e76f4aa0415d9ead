"""`wholearm scenes`: the bundled scenes."""


def scenes() -> None:
    """List the bundled scenes."""
    from wholearm_jax.files import bundled, load

    for name in bundled():
        scene = load(name)
        print(f"{name}: {scene.title}; " + ", ".join(phase.name for phase in scene.phases))
