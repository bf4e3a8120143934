"""The manifest of a release: the same text for the same facts, and plain words for anything else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.deploy.release.manifest import Manifest, Target, id_for, is_id
from fullswarm.errors import ConfigError

FACTS = Manifest(
    "0.1.0-0123456789ab", "0.1.0", Target("rpi-arm64", "aarch64", "2.28", "3.11"), ("can",), {"numpy": "2.4.6"}
)


def test_what_is_written_is_read_back() -> None:
    assert Manifest.parse(FACTS.to_json()) == FACTS


def test_the_text_does_not_depend_on_the_order_of_the_packages() -> None:
    one = replace(FACTS, packages={"a": "1", "b": "2"})
    other = replace(FACTS, packages={"b": "2", "a": "1"})
    assert one.to_json() == other.to_json()


def test_a_target_names_its_newest_wheel_tag() -> None:
    assert FACTS.target.manylinux == "aarch64-manylinux_2_28"


def test_the_id_is_of_all_facts_and_all_files_but_not_of_itself() -> None:
    first = id_for(FACTS, "sums")
    assert is_id(first)
    assert first.startswith("0.1.0-")
    assert id_for(replace(FACTS, id="0.1.0-ffffffffffff"), "sums") == first
    assert id_for(FACTS, "other sums") != first
    changed = (
        replace(FACTS, version="0.1.1"),
        replace(FACTS, extras=()),
        replace(FACTS, packages={"numpy": "2.4.7"}),
        replace(FACTS, target=replace(FACTS.target, python="3.13")),
    )
    assert len({first.split("-")[-1], *(id_for(each, "sums").split("-")[-1] for each in changed)}) == 5


@pytest.mark.parametrize(
    "text", ["", "..", "../x-0123456789ab", "0.1-0123456789AB", "0.1-0123", "a b-0123456789ab", "-0123456789ab"]
)
def test_what_cannot_be_an_id(text: str) -> None:
    assert not is_id(text)


def _without(key: str) -> dict[str, Any]:
    raw = json.loads(FACTS.to_json())
    del raw[key]
    return dict(raw)


@pytest.mark.parametrize("key", ["format", "id", "version", "target", "extras", "packages", "robot_protocol"])
def test_a_manifest_without_a_key_is_refused_with_its_name(key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        Manifest.parse(json.dumps(_without(key)))


def test_another_format_says_what_to_do() -> None:
    with pytest.raises(ConfigError, match="format 2") as caught:
        Manifest.parse(FACTS.to_json().replace('"format": 1', '"format": 2'))
    assert "update fullswarm" in caught.value.hint


@given(st.text() | st.recursive(st.none() | st.integers() | st.text(), st.lists).map(json.dumps))
def test_anything_else_is_refused_not_crashed_on(text: str) -> None:
    with pytest.raises(ConfigError):
        Manifest.parse(text)


def test_a_folder_without_a_manifest_is_no_release(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not a release"):
        Manifest.read(tmp_path)
