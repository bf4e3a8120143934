"""The records of the makes: what they name exists, the documentation shows them, an outside one may be broken."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

from fullswarm import registry
from fullswarm.drivers import make as records
from fullswarm.drivers.guardian import takes_guardian
from fullswarm.drivers.make import Make, built_in, emulated, make_of, part, range_sensors

README = Path(__file__).parents[2] / "fullswarm" / "drivers" / "README.md"


def row(make: Make) -> str:
    """Return a make's line in the table of the documentation."""
    return f"| `{make.example}` | {make.robots} | {make.limits} | {'' if make.simulated else make.proven()} |"


@pytest.mark.parametrize("make", [*built_in(), *range_sensors()], ids=lambda make: make.name)
def test_what_a_record_names_exists(make: Make) -> None:
    assert all(make_of(f"{scheme}:") is make for scheme in make.schemes)
    driver = make.driver_class()(make.example)
    assert driver.url == make.example
    names = [make.probe] if make.probe else []
    if make.emulation is not None:
        names += [make.emulation.start, make.emulation.bench, make.emulation.clients, make.emulation.mode]
    assert all(part(each) for each in names if each)
    assert make.guarded == takes_guardian(driver)


@pytest.mark.parametrize("make", [*built_in(), *range_sensors()], ids=lambda make: make.name)
def test_the_documentation_shows_each_make_with_its_evidence(make: Make) -> None:
    assert row(make) in README.read_text("utf-8").splitlines(), f"write into drivers/README.md: {row(make)}"


def test_no_make_claims_hardware_that_the_readme_denies() -> None:
    assert not any(each.on_hardware for each in (*built_in(), *range_sensors()))
    assert "have never driven hardware" in (README.parents[2] / "README.md").read_text("utf-8")


def test_the_words_of_fleet_files_are_those_of_the_records() -> None:
    ros = {"turtlebot3", "turtlebot3_bridge", "turtlebot3_rosbridge", "turtlebot4"}
    assert set(emulated()) == {"create1", "roomba500", "create2", "rover", "odrive", "vesc", *ros}


def test_reading_all_records_imports_no_library_of_a_make_and_no_emulator() -> None:
    lookup = (
        "import sys; from fullswarm.drivers.make import makes; makes(); "
        "print([each for each in sys.modules if each.startswith(('fullswarm.emulators', 'pymavlink', 'can', 'serial', "
        "'numpy'))])"
    )
    done = subprocess.run([sys.executable, "-c", lookup], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_outside_make_that_does_not_import_is_named_and_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    group = registry.DRIVER_GROUP
    broken = importlib.metadata.EntryPoint("half", "no_such_package:MAKE", group)
    alone = importlib.metadata.EntryPoint("plain", "fullswarm.drivers.null.driver:NullDriver", group)

    def entry_points(**named: str) -> tuple[importlib.metadata.EntryPoint, ...]:
        return tuple(
            each for each in (broken, alone) if named["group"] == group and named.get("name", each.name) == each.name
        )

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    monkeypatch.setattr(registry, "_installed", registry._installed.__wrapped__)  # which remembers what is installed
    assert {each.name for each in records.makes()} == {*(each.name for each in built_in()), "plain"}
    assert "no_such_package" in records.broken()["half:"]
    assert registry.driver_class("plain://r1").__name__ == "NullDriver"
