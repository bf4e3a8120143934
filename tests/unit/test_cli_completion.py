from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from fullswarm.cli.completion import Known, from_fleet, joined, known_from, resolved

FLEET = """
swarm = "lab"
[fleet]
count = 2
[[robot]]
id = "rover"
[groups]
scouts = ["r1", "rover"]
"""


def test_a_fleet_file_names_robots_and_groups(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(FLEET)
    assert from_fleet(file, Known()) == Known(("rover", "r1", "r2"), {"scouts": ("r1", "rover")})


def test_a_core_reports_groups_behaviours_and_keys() -> None:
    entries = {
        "behaviour/a": {"summary": "go", "parameters": {"gain": {"default": 1.0}}},
        "behaviour/a_bc": {"like": "a", "filtered": True},
        "group/scouts": {"robots": ["r10"]},
        "agent/x": 1,
    }
    known = known_from({"r10", "r2"}, entries)
    assert (known.robots, known.groups) == (("r2", "r10"), {"scouts": ("r10",)})
    assert known.behaviours["a_bc"]["parameters"] == {"gain": {"default": 1.0}}
    assert known.keys == ("agent/x", "behaviour/a", "behaviour/a_bc", "group/scouts")


def test_broken_records_are_passed_over() -> None:
    assert list(resolved({"a": 3, "b": {"like": "a"}, "c": {"like": "nobody"}})) == ["b", "c"]


@given(
    st.lists(st.text(alphabet="ab=@,:- ", max_size=6), min_size=1, max_size=8),
    st.one_of(st.integers(0, 10).map(str), st.text(max_size=3)),
)
def test_any_line_is_mended_without_losing_a_letter(words: list[str], at: str) -> None:
    whole, place, kept = joined(words, at)
    assert "".join(whole) == "".join(words)
    assert 0 <= place < len(whole)
    assert whole[place].startswith(kept)
