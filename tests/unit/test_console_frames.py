from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.messages import BehaviourRequest
from fullswarm.operator.console import frames
from fullswarm.operator.console.frames import Answer, Drive, Request, read_command, read_hello
from tests.unit.console_bench import ConsoleBench

scalars = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20))
trees = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=20,
)  # fmt: skip
NAMES = ["t", "ref", "behaviour", "robots", "parameters", "take", "sticks", "fixed", "hold", "reason", "extra"]
KINDS = ["request", "stop", "estop", "clear", "drive", "release", "lease", "ping", "hello", "nonsense"]
likely = st.one_of(
    st.sampled_from(["r1", "@scouts", "drive_bc", "move_to_goal_bc", "../x", ""]),
    st.just(["r1"]), st.just({"goal": [1, 2]}), st.just({"linear": 1}), st.booleans(), st.integers(0, 9), trees,
)  # fmt: skip
objects = st.dictionaries(st.sampled_from(NAMES), likely, max_size=8).flatmap(
    lambda fields: st.sampled_from(KINDS).map(lambda t: {**fields, "t": t})
)


def test_a_request_is_read_with_its_parameters() -> None:
    text = json.dumps({"t": "request", "ref": 3, "behaviour": "b", "parameters": {"goal": [1, 2.5], "slow": True}})
    command = read_command(text)
    assert isinstance(command, Request)
    assert command.parameters == {"goal": [1, 2.5], "slow": True}
    assert command.robots == ()


@pytest.mark.parametrize(
    ("frame", "ref"),
    [
        ({"t": "fly", "ref": 1}, 1),
        ({"t": "stop", "ref": 2, "now": True}, 2),
        ({"t": "stop", "ref": -1}, None),
        ({"t": "stop"}, None),
        ({"t": "stop", "ref": 5, "robots": "r1"}, 5),
        ({"t": "stop", "ref": 5, "robots": ["r1/../*"]}, 5),
        ({"t": "stop", "ref": 5, "robots": ["r1\n"]}, 5),
        ({"t": "request", "ref": 6, "behaviour": "a", "parameters": {"n": {"deep": 1}}}, 6),
        ({"t": "request", "ref": 6, "behaviour": "a", "parameters": {"n": 2**60}}, 6),
        ({"t": "request", "ref": 6, "behaviour": "a", "parameters": {"n": [[1, 10**400]]}}, 6),
        ({"t": "request", "ref": 6, "behaviour": "a", "parameters": {"n": "x" * 2000}}, 6),
        ({"t": "request", "ref": 6, "behaviour": "a", "needs": {"speed": 1.0}}, 6),
        ({"t": "request", "ref": 6, "behaviour": "a", "needs": {"battery": 2.0}}, 6),
        ({"t": "request", "ref": 6, "behaviour": "a", "roles": {"leader": "r1"}}, 6),
        ({"t": "request", "ref": 6, "behaviour": "a", "team": "x" * 66}, 6),
        ({"t": "drive", "ref": 7, "behaviour": "a", "sticks": {"linear": 1.5}}, 7),
        ({"t": "drive", "ref": 7, "behaviour": "a", "sticks": {}}, 7),
        ([], None),
    ],
)
def test_what_is_wrong_is_answered_with_its_reference(frame: Any, ref: int | None) -> None:
    answer = read_command(json.dumps(frame))
    assert isinstance(answer, Answer)
    assert (answer.ok, answer.ref) == (False, ref)
    assert answer.reason


def test_a_word_that_is_not_json_is_answered() -> None:
    for text in ("", "{", "nan", "\x00", "[" * 60_000, b"\xff\xfe", '{"t":"stop","ref":1e999}'):
        assert isinstance(read_command(text), Answer)
        assert read_hello(text) is None


def test_a_greeting_needs_a_session_that_is_hard_to_guess() -> None:
    good = {"t": "hello", "token": "x", "session": "a1-_b2c3", "name": "Anna K."}
    assert read_hello(json.dumps(good)) is not None
    for wrong in ({"session": "short"}, {"session": "a/b/c/d/e"}, {"name": "<b>"}, {"token": "x" * 600}, {"more": 1}):
        assert read_hello(json.dumps({**good, **wrong})) is None


def test_numbers_that_are_not_finite_become_null() -> None:
    assert frames.encode({"x": float("nan"), "y": float("inf")}) == '{"x":null,"y":null}'


@settings(max_examples=50, deadline=None)
@given(objects | trees)
def test_no_frame_gets_past_the_check_that_the_bus_cannot_carry(frame: Any) -> None:
    command = read_command(json.dumps(frame))
    if isinstance(command, Request | Drive):
        parameters = command.parameters if isinstance(command, Request) else {**command.fixed, **command.sticks}
        request = BehaviourRequest(id="x", behaviour=command.behaviour, robots=command.robots, parameters=parameters)
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(request), type=BehaviourRequest) == request
    if isinstance(command, Answer):
        assert not command.ok


@given(st.binary(max_size=200))
def test_any_bytes_are_answered(data: bytes) -> None:
    read_command(data)
    read_hello(data)


@settings(max_examples=20, deadline=None)
@given(st.lists(objects, max_size=8))
def test_any_frames_are_answered_by_a_desk(story: list[Any]) -> None:
    bench = ConsoleBench()
    page, session = bench.join()
    for frame in story:
        command = read_command(json.dumps(frame))
        answer = command if isinstance(command, Answer) else session.handle(command, page)
        assert json.loads(answer.encoded())["t"] == "answer"
        bench.run(0.05)
