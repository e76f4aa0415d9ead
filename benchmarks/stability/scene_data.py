"""One random scene as the nested data of a scene file, to look into it alone."""

import numpy as np

from benchmarks.stability.scenes import Scenes


def as_data(scenes: Scenes, row: int) -> dict:
    """One scene as the nested data of a scene file (see `wholearm_jax.parse`), to look into it alone."""
    one = {name: value[row] for name, value in scenes._asdict().items()}
    links, kinds, coordinates = ("palm", "finger1", "finger2"), "ve", ("x", "y", "phi", "theta1", "theta2")
    rows = zip(one["link"], one["kind"], one["feature"], strict=True)
    names = [f"{links[a]}:{kinds[b]}{c}" for a, b, c in rows]
    rolls = [*one["tangential"][1:], False]
    contacts = [
        name + " rolling" * bool(roll)
        for name, roll, skip in zip(names, rolls, one["tangential"], strict=True)
        if not skip
    ]
    fingers = {
        f"finger{k + 1}": {
            "joint": one["joint"][k].tolist(),
            "length": float(one["length"][k]),
            "offset": float(one["offset"][k]),
            "back": float(one["back"][k]),
            "range": np.clip(one["range"][k], -1e3, 1e3).tolist(),
            "inertia": float(one["joint_inertia"][k]),
            "viscous": float(one["viscous"][k]),
            "dry": float(one["dry"][k]),
            "torque_limit": float(one["torque_limit"][k]),
        }
        for k in (0, 1)
    }
    solid = {
        "vertices": one["vertices"][: one["count"]].tolist(),
        "mass": float(one["mass"]),
        "friction": dict(zip(links, one["friction"].tolist(), strict=True)),
    }
    fingers["fingers"] = "layered" if one["layered"] else "coplanar"
    solid["flush_tolerance"] = float(one["flush_tolerance"])
    solid |= {} if one["uniform"] else {"inertia": float(one["inertia"])}
    phase = {
        "name": "phase",
        "contacts": contacts,
        "toward": coordinates[one["coordinate"]] + ("+" if one["sign"] > 0 else "-"),
        "duration": float(one["duration"]),
        "arrive": "rest" if one["at_rest"] else "moving",
    }
    if one["until_coordinate"] >= 0:
        phase["until"] = {coordinates[one["until_coordinate"]]: float(one["until_value"])}
    start = dict(zip(coordinates, one["rough"].tolist(), strict=True))
    return {
        "title": "a random scene",
        "gravity": one["gravity"].tolist(),
        "hand": fingers,
        "object": solid,
        "start": start,
        "phase": [phase],
    }
