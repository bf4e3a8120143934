"""A scenario as TOML, which `load_scenario` reads back equal."""

from __future__ import annotations

from collections.abc import Iterable

import tomlkit
from tomlkit.items import Array, Table

from fullswarm.config import Section
from fullswarm.evaluate.scenarios.model import Scenario


def scenario_to_toml(scenario: Scenario, notes: Iterable[str] = ()) -> str:
    """Return a scenario's file; `notes` become comments at its head."""
    document = tomlkit.document()
    for note in notes:
        # A comment ends at the line's end, and may hold no control character.
        document.add(tomlkit.comment("".join(each if each.isprintable() else " " for each in note)))
    for key, value in scenario.model_dump(exclude={"boxes", "random_boxes", "spawn", "goal"}).items():
        document.add(key, list(value) if isinstance(value, tuple) else value)
    if scenario.boxes:
        document.add("boxes", _boxes(scenario))
    for key, section in (
        ("random_boxes", scenario.random_boxes),
        ("spawn", scenario.spawn),
        ("goal", scenario.goal),
    ):
        if section is not None:
            document.add(key, _table(section))
    return tomlkit.dumps(document)


def _boxes(scenario: Scenario) -> Array:
    boxes = tomlkit.array()
    for box in scenario.boxes:
        boxes.append(list(box))
    return boxes.multiline(True)


def _table(section: Section) -> Table:
    table = tomlkit.table()
    for key, value in section.model_dump(exclude_none=True).items():
        table.add(key, list(value) if isinstance(value, tuple) else value)
    return table
