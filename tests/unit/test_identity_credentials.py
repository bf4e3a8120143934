"""The list of valid certificates: read as written, refused with what is wrong."""

import json
from pathlib import Path

import msgspec
import pytest

from fullswarm.errors import ConfigError
from fullswarm.identity import Grant, read_grants

TWICE = {"common_name": "a.1", "name": "r1", "role": "robot"}


def test_a_list_is_read_as_it_was_written(tmp_path: Path) -> None:
    grants = (Grant("r1.1", "r1", "robot"), Grant("anna.2", "anna", "operator"))
    (tmp_path / "grants.json").write_bytes(msgspec.json.encode(grants))
    assert read_grants(tmp_path / "grants.json") == grants


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ([{"common_name": "r1.1", "name": "r1", "role": "king"}], "king"),
        ([{"common_name": "r1.1", "name": "r1"}], "role"),
        ([{"common_name": "r1.1", "name": "*", "role": "robot"}], "'*'"),
        ([TWICE, {**TWICE}], "a.1"),
        ([TWICE, {**TWICE, "common_name": "r1.2", "role": "operator"}], "'operator'"),
        ([{"common_name": "a.1", "name": "core", "role": "operator"}], "'core' cannot have the role 'operator'"),
        ([{"common_name": "a.1", "name": "base", "role": "core"}], "'base' cannot have the role 'core'"),
        ([{"common_name": "a.1", "name": "truth", "role": "robot"}], "'truth'"),
        ([{"common_name": "a.1", "name": "unnamed", "role": "robot"}], "'unnamed'"),
        ([{"common_name": "", "name": "r1", "role": "robot"}], "common name"),
        ({"r1": "robot"}, "array"),
    ],
)  # fmt: skip
def test_a_list_that_grants_something_unclear_is_refused(tmp_path: Path, entries: object, named: str) -> None:
    file = tmp_path / "grants.json"
    file.write_text(json.dumps(entries))
    with pytest.raises(ConfigError) as caught:
        read_grants(file)
    assert named in str(caught.value)
    assert str(file) in str(caught.value)


def test_a_missing_list_is_an_error_that_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="fullswarm keys init"):
        read_grants(tmp_path / "grants.json")
