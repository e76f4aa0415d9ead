"""`wholearm scenes`: the bundled scenes."""

from wholearm_jax.cli.arguments import AsJson


def scenes(as_json: AsJson = False) -> None:
    """List the bundled scenes."""
    from wholearm_jax.cli.tables import print_json
    from wholearm_jax.files import bundled, load

    listed = [(name, load(name)) for name in bundled()]
    if as_json:
        print_json([{"name": n, "title": s.title, "phases": [p.name for p in s.phases]} for n, s in listed])
        return
    for name, scene in listed:
        print(f"{name}: {scene.title}; " + ", ".join(phase.name for phase in scene.phases))
