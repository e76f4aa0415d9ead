"""`wholearm search`: the paper's search for torques."""

from wholearm_jax.cli.arguments import (
    AsJson,
    BadInput,
    OutputFolder,
    Samples,
    SceneName,
    load_scene,
    make_output_folder,
)
from wholearm_jax.cli.output import print_phases, write_and_exit
from wholearm_jax.cli.prediction import trace_or_exit


def search(scene: SceneName, out: OutputFolder = None, samples: Samples = 201, as_json: AsJson = False) -> None:
    """The paper's search for torques by steps of 10 %."""
    loaded = load_scene(scene)
    folder = make_output_folder(out)
    from wholearm_jax.core import wait_for
    from wholearm_jax.optimisation import certified_bounds, explain, precompile_search, search_by_steps

    compiled = precompile_search()
    traced = trace_or_exit(scene, loaded)
    wait_for(compiled)
    try:
        optimum = search_by_steps(loaded, traced=traced)
    except ValueError as error:
        raise BadInput(f"{scene}: {error}") from None
    result = explain(optimum.result)
    if not as_json:
        print_phases(result)
        print(f"{optimum.simulations} simulations in {optimum.seconds:.2f} s")
    values = tuple(float(b.value) for b in certified_bounds(result.scene, traced=traced))
    more = {"simulations": optimum.simulations, "seconds": optimum.seconds}
    write_and_exit(result, folder, samples, as_json, bounds=values, command="search", **more)
