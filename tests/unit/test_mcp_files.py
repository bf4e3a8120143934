"""What the MCP server reads from files: results of experiments, the fleet file, the audit log."""

from __future__ import annotations

import asyncio
import json
import statistics
from pathlib import Path
from typing import Any, cast

import pytest

from fullswarm.errors import ConfigError
from fullswarm.mcp_server.access import Access
from fullswarm.mcp_server.reads import Reads, fleet_lines
from fullswarm.operator.swarm import Client
from tests.unit.results_fixture import FAILURE, write_folder


def ask(
    tool: str, *, fleet: Path | None = None, results: Path | None = None, audit: Path = Path(), **given: Any
) -> Any:
    """Return the answer of a tool that needs no swarm."""
    tools = Reads(Access(cast(Client, None), fleet, results), audit).tools()
    found = asyncio.run(next(each for each in tools if each.name == tool).answer(given))
    assert not found.is_error, found.structured_content
    return found.structured_content


def test_results_are_means_per_cell_as_in_the_files_of_the_trials(tmp_path: Path) -> None:
    write_folder(tmp_path)
    found = ask("experiment_results", results=tmp_path)
    assert sum(each["trials"] for each in found["cells"]) == 32
    assert sum(each["failed"] for each in found["cells"]) == len([FAILURE])
    cell = next(each for each in found["cells"] if not each["failed"])
    values = []
    for path in (tmp_path / "trials").glob("*/result.json"):
        record = json.loads(path.read_text())
        about = record["trial"]["cell"]
        same = (about["scenario"], about["robots"]) == (cell["scenario"], cell["robots"])
        if same and about["behaviour"] == cell["label"].split()[0]:
            values.append(record["outcome"]["simulated_s"])
    assert len(values) == cell["trials"]
    assert cell["means"]["outcome/simulated_s"] == pytest.approx(statistics.fmean(values))
    few = ask("experiment_results", results=tmp_path, contains=cell["scenario"], limit=1)
    assert (len(few["cells"]), few["cells_in_folder"]) == (1, len(found["cells"]))
    assert few["cells"][0]["scenario"] == cell["scenario"]


def test_a_fleet_file_is_shown_without_its_logins(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(
        '[fixes]\nsource = "rtsp://anna:secret@10.0.0.3/live"\nnote = "r@x"\n'
        'other = "http://u:p@ss/w@cam/x?y=1@2"\nranges = "vl53l1x:///dev/i2c-1?sensor=0@0.1,0,0"\n'
    )
    lines = ask("fleet_file", fleet=file)["lines"]
    assert lines == [
        "[fixes]",
        'source = "rtsp://***@10.0.0.3/live"',
        'note = "r@x"',
        'other = "http://***@cam/x?y=1@2"',
        'ranges = "vl53l1x:///dev/i2c-1?sensor=0@0.1,0,0"',
    ]
    with pytest.raises(ConfigError, match="cannot be read"):
        fleet_lines(tmp_path)


def test_entries_of_the_audit_log_are_filtered_and_bounded(tmp_path: Path) -> None:
    entries = [
        {
            "time": f"2026-11-27T10:00:{number:02}+00:00",
            "act": "request",
            "operator": f"o{number % 2}",
            "robots": ["r1"],
        }
        for number in range(60)
    ]
    (tmp_path / "00000001.jsonl").write_text("".join(json.dumps(each) + "\n" for each in entries) + '{"cut off')
    found = ask("audit_log", audit=tmp_path, since="2026-11-27T10:00:00+00:00", operator="o1", limit=3)
    assert found["that_fit"] == 30
    assert found["entries"] == [entries[number] for number in (55, 57, 59)]
