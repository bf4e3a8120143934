"""What `fullswarm scenario` does: list, show, import and export arenas."""

from __future__ import annotations

from pathlib import Path

from fullswarm import output
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.scenarios import Scenario, boxes_for, goals_for, load_scenario, scenario_names, spawn

RADIUS_M = 0.17
"""Of the robots that are shown: a Create's."""

EXPORTS = ("sdf", "pgm")


def list_all(as_json: bool) -> int:
    """Print the scenarios of the package."""
    scenarios = [load_scenario(name) for name in scenario_names()]
    if as_json:
        output.data_json([{"name": each.name, "description": each.description} for each in scenarios])
        return 0
    table = output.plain_table("scenario", "arena, m", "boxes", "what it is")
    for each in scenarios:
        count = len(each.boxes) + (each.random_boxes.count if each.random_boxes else 0)
        table.add_row(each.name, _size(each), str(count), each.description)
    output.data_table(table)
    return 0


def show(name: str, seed: int, robots: int, as_json: bool) -> int:
    """Print a scenario: for people with a map of it, for programs with all numbers.

    Raises
    ------
    ConfigError
        No such scenario, or boxes or robots do not fit.
    """
    scenario = load_scenario(_path_or_name(name))
    boxes = boxes_for(scenario, seed)
    poses = spawn(scenario, robots, seed, RADIUS_M)
    if as_json:
        placed = {
            "seed": seed,
            "boxes": [list(box) for box in boxes],
            "starts": poses.tolist(),
            "goals": goals_for(scenario, poses).tolist(),
        }
        output.data_json({"scenario": scenario.model_dump(mode="json", exclude_none=True), "placed": placed})
        return 0
    from fullswarm.evaluate.scenarios.maps import LEGEND, text_map

    output.data(f"{scenario.name}: {scenario.description}".removesuffix(": "))
    output.data(f"{_size(scenario)} m, {len(boxes)} boxes, {robots} robots, seed {seed}")
    output.data(text_map(scenario, boxes, [(x, y) for x, y, _ in poses.tolist()]))
    output.data(LEGEND)
    return 0


def import_world(file: Path, form: str | None, out: Path | None, as_json: bool) -> int:
    """Make a scenario of another simulator's world: TOML to stdout or `out`, notes to stderr.

    Raises
    ------
    ConfigError
        The world cannot be read, or `out` not be written.
    MissingExtra
        The reader of XML or YAML is not installed.
    """
    from fullswarm.evaluate.scenarios.importers import read_world
    from fullswarm.evaluate.scenarios.model import scenario_to_toml

    imported = read_world(file, form)
    for note in imported.notes:
        output.progress(f"note: {note}")
    text = scenario_to_toml(imported.scenario, [f"Imported from {file.name}.", *imported.notes])
    if out is not None:
        _write(out, text)
        output.progress(f"wrote {out}: {len(imported.scenario.boxes)} boxes; see it: fullswarm scenario show {out}")
    if as_json:
        starts = [[each.x, each.y, each.yaw] for each in imported.starts]
        scenario = imported.scenario.model_dump(mode="json", exclude_none=True)
        output.data_json({"scenario": scenario, "notes": list(imported.notes), "starts": starts})
    elif out is None:
        output.data(text.removesuffix("\n"))
    return 0


def export(name: str, form: str, robots: int, seed: int, out: Path, cell_m: float, model: str, driven: bool) -> int:
    """Write a scenario for Gazebo (sdf) or as a map for ROS (pgm and yaml).

    Raises
    ------
    ConfigError
        No such scenario, format or model, boxes or robots do not fit, or `out` cannot be written.
    """
    if form not in EXPORTS:
        raise ConfigError(f"there is no format '{form}'", where="--format", hint=did_you_mean(form, EXPORTS))
    scenario = load_scenario(_path_or_name(name))
    if form == "pgm":
        from fullswarm.evaluate.scenarios.maps import scenario_map, write_map

        picture, sidecar = write_map(scenario_map(scenario, seed, cell_m), out)
        output.progress(f"wrote {picture} and {sidecar}")
        return 0
    from fullswarm.evaluate.scenarios.export_sdf import scenario_to_sdf

    _write(out, scenario_to_sdf(scenario, seed, robots, model=model, driven=driven))
    output.progress(f"wrote {out}; see it: gz sim {out}")
    return 0


def _path_or_name(text: str) -> str | Path:
    """Return a path for what is one: `load_scenario` takes other text for a name."""
    return Path(text) if text.endswith(".toml") or "/" in text else text


def _write(out: Path, text: str) -> None:
    try:
        out.write_text(text, "utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write: {error.strerror or error}", where=str(out)) from error


def _size(scenario: Scenario) -> str:
    x_min, y_min, x_max, y_max = scenario.bounds_m
    return f"{x_max - x_min:g} x {y_max - y_min:g}"
