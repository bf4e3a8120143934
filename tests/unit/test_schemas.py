"""The description of the wire for other programs: schemas, keys, and the page made of them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import msgspec
import pytest
from typer.testing import CliRunner

from fullswarm import schemas
from fullswarm.cli.main import app
from fullswarm.messages import BehaviourRequest, EStop, Heartbeat, LeaseRequest, Message, StopRequest

PAGE = Path(__file__).parents[2] / "docs" / "reference-messages.md"
SENT: tuple[Message, ...] = (
    BehaviourRequest(id="a", behaviour="flocking_bc", parameters={"goal": [1.0, 2.0]}),
    StopRequest(id="b", source="test"),
    EStop(id="c", engaged=True, source="test"),
    LeaseRequest(operator="anna", robots=("r1",), hold=True),
)


def run(*words: str) -> str:
    result = CliRunner().invoke(app, ["schema", *words])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_the_page_of_the_documentation_is_made_of_the_code() -> None:
    assert PAGE.read_text(encoding="utf-8") == schemas.page(), "fullswarm schema --page > docs/reference-messages.md"
    assert run("--page") == schemas.page()


@pytest.mark.parametrize("message", SENT, ids=lambda each: type(each).__name__)
def test_a_message_as_it_is_sent_fits_its_schema_and_a_wrong_one_does_not(message: Message) -> None:
    schema = json.loads(run(type(message).__name__))
    sent = json.loads(msgspec.json.encode(message))  # the same fields as in MessagePack
    jsonschema.validate(sent, schema)
    for wrong in ({**sent, "unknown": 1}, {**sent, "kind": "Other/1"}, {"kind": sent["kind"]}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema)


def test_each_message_of_the_bus_is_listed_once_with_its_version() -> None:
    lines = run().splitlines()
    assert [line.split()[0] for line in lines] == [schemas.tag_of(each) for each in schemas.messages().values()]
    assert json.loads(run("--json"))["Heartbeat"] == schemas.tag_of(Heartbeat)


def test_all_schemas_and_keys_are_written_into_a_folder(tmp_path: Path) -> None:
    run("--out", str(tmp_path / "wire"))
    written = {path.stem for path in (tmp_path / "wire").iterdir()}
    assert written == {*schemas.messages(), "keys"}
    keys = json.loads((tmp_path / "wire" / "keys.json").read_text())
    stop = next(each for each in keys if each["key"] == "<swarm>/<sender>/stop")
    assert stop["messages"] == [schemas.tag_of(StopRequest)]
    assert stop["receive"]["robot"] == "*"
    assert "observer" not in stop["publish"]
    for path in (tmp_path / "wire").glob("[A-Z]*.json"):
        jsonschema.Draft202012Validator.check_schema(json.loads(path.read_text()))


def test_a_wrong_name_and_options_that_exclude_each_other_are_errors_of_usage(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["schema", "Pong"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert "did you mean 'Ping'?" in result.stderr
    result = CliRunner().invoke(app, ["schema", "Ping", "--out", str(tmp_path)])
    assert result.exit_code == 2
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert CliRunner().invoke(app, ["schema", "--out", str(blocked)]).exit_code == 2
