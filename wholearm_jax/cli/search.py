"""`wholearm search`: the paper's search for torques."""

from wholearm_jax.cli.arguments import BadInput, OutputFolder, Samples, SceneName, load_scene, make_output_folder
from wholearm_jax.cli.output import print_phases, write_and_exit
from wholearm_jax.cli.prediction import trace_or_exit


def search(scene: SceneName, out: OutputFolder = None, samples: Samples = 201) -> None:
    """The paper's search for torques by steps of 10 %."""
    loaded = load_scene(scene)
    folder = make_output_folder(out)
    from wholearm_jax.core import wait_for
    from wholearm_jax.optimisation import bounds, precompile_search, search_by_steps

    compiled = precompile_search()
    traced = trace_or_exit(scene, loaded)
    wait_for(compiled)
    try:
        found = search_by_steps(loaded, traced=traced)
    except ValueError as error:
        raise BadInput(f"{scene}: {error}") from None
    print_phases(found.result)
    print(f"{found.simulations} simulations in {found.seconds:.2f} s")
    values = tuple(float(b.value) for b in bounds(found.result.scene, traced=traced))
    more = {"simulations": found.simulations, "seconds": found.seconds}
    write_and_exit(found.result, folder, samples, bounds=values, command="search", **more)
