"""Player configurations (playerproject.github.io): the Stage world that they load, and which of its models are robots.

A ``driver`` section that provides ``simulation:0`` names the world; sections with ``model`` attach interfaces to models
of it. Those that provide ``position2d`` make robots: other models that could drive stand still, as in Stage. The syntax
is that of Stage's worlds (libplayercore/configfile.cc and libstage/worldfile.cc come from one source).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.scenarios.importers import stage
from fullswarm.evaluate.scenarios.importers.draft import Draft, Imported, Planar
from fullswarm.evaluate.scenarios.importers.stage import Entity, joined, text_of

MOTION = ("position2d", "position")
"""Interfaces that drive a robot; the second is Player 1's and early Player 2's."""
DRAWN = 20
"""Robots that are named one by one in the notes."""


@dataclass(frozen=True, slots=True)
class _Address:
    """A device's address: ``[key:[host:[port:]]]interface:index``."""

    text: str

    @property
    def interface(self) -> str:
        """Its kind."""
        return self.text.split(":")[-2] if ":" in self.text else self.text


def read(path: Path) -> Imported:
    """Return the Stage world of a Player configuration as a scenario.

    Raises
    ------
    ConfigError
        Not readable or not in the syntax, named with its line; there is no Stage world, or a model that a driver
        names is not in it.
    """
    config = stage.parse(path, "Player configuration")
    draft = Draft(str(path))
    for file in config.missing:
        draft.note(f'include "{file}" of {path.name}: there is no such file')
    drivers = [part for part in config.root.parts if part.kind == "driver"]
    for part in config.root.parts:
        if part.kind != "driver":
            draft.note(f"{part.kind} ({part.where}): not a driver: left out")
    world_path, simulation = _world_of(drivers, path)
    wanted: dict[str, Entity] = {}
    for driver in drivers:
        if driver is not simulation:
            _read_driver(driver, wanted, draft)
    world = stage.parse(world_path)
    found = stage.collect(world, draft, frozenset(wanted))
    _check_models(wanted, found, world, world_path)
    draft.starts = [found[name] for name in wanted if name in found]
    _note_robots(wanted, found, draft)
    name = text_of(world.root, "name") or world_path.stem
    return draft.finish(name, f"From the Player configuration {path.name} and its Stage world {world_path.name}")


def _world_of(drivers: list[Entity], path: Path) -> tuple[Path, Entity]:
    """Return the world's file and the driver that loads it."""
    simulations = [each for each in drivers if any(one.interface == "simulation" for one in _addresses(each))]
    if not simulations:
        raise ConfigError(
            "no driver provides simulation:0",
            where=str(path),
            hint="only configurations that load a Stage world make a scenario",
        )
    if len(simulations) > 1:
        raise ConfigError(
            f"a second driver provides a simulation, after {simulations[0].where}", where=simulations[1].where
        )
    driver = simulations[0]
    plugin = text_of(driver, "plugin")
    if "stage" not in plugin and not text_of(driver, "name").startswith(("stage", "stg_")):
        raise ConfigError(f"the simulation's plugin is '{plugin}', not Stage's", where=driver.where)
    file = text_of(driver, "worldfile")
    if not file:
        raise ConfigError("the simulation names no worldfile", where=driver.where, hint='worldfile "hall.world"')
    world = path.parent / file
    if not world.is_file():
        raise ConfigError(f'worldfile "{file}": there is no such file', where=driver.where)
    return world, driver


def _addresses(driver: Entity) -> list[_Address]:
    words = [joined(driver.properties[key]) for key in ("provides", "devices") if key in driver.properties]
    return [_Address(word) for text in words for word in text.split()]


def _read_driver(driver: Entity, wanted: dict[str, Entity], draft: Draft) -> None:
    """Take a robot from a driver of Stage; what else there is has no place in a scenario."""
    name, model, provided = text_of(driver, "name") or "driver", text_of(driver, "model"), _addresses(driver)
    listed = ", ".join(each.text for each in provided) or "nothing"
    if not name.startswith(("stage", "stg_")):
        draft.note(f"driver {name} ({driver.where}), which provides {listed}: runs in Player, left out")
        return
    if not model:
        raise ConfigError(f"the driver that provides {listed} names no model", where=driver.where)
    if not any(each.interface in MOTION for each in provided):
        draft.note(f"{listed} of {model} ({driver.where}): a scenario has no sensors and grippers, left out")
        return
    if model in wanted:
        raise ConfigError(f"the model '{model}' has a driver already, {wanted[model].where}", where=driver.where)
    wanted[model] = driver
    others = ", ".join(each.text for each in provided if each.interface not in MOTION)
    if others:
        draft.note(f"{others} of {model}: a scenario has no sensors and grippers, left out")


def _check_models(wanted: dict[str, Entity], found: dict[str, Planar], world: stage.WorldFile, path: Path) -> None:
    for name, driver in wanted.items():
        if name in found:
            continue
        if world.missing:
            hint = f"{path.name} includes files that are not there: {', '.join(world.missing)}"
        else:
            hint = did_you_mean(name, stage.names_in(world))
        raise ConfigError(f"the model '{name}' is not in {path.name}", where=driver.where, hint=hint)


def _note_robots(wanted: dict[str, Entity], found: dict[str, Planar], draft: Draft) -> None:
    for name in list(wanted)[:DRAWN]:
        motion = next(each.text for each in _addresses(wanted[name]) if each.interface in MOTION)
        start = found[name]
        draft.note(f"robot {name} ({motion}) starts at {start.x:.2f}, {start.y:.2f} m, heading {start.yaw:.2f} rad")
