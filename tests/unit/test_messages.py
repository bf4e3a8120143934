"""Messages survive the wire; what is not ours is refused with a reason."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm import messages
from fullswarm.bus.codec import decode, encode
from fullswarm.errors import ConfigError, MessageError
from fullswarm.keys import Keys, cell_of, cells_within
from fullswarm.messages import BehaviourRequest, Command, Message

words = st.text(max_size=20)
numbers = st.floats(allow_nan=False, allow_infinity=False)
values = st.one_of(
    st.booleans(),
    st.integers(-(2**53), 2**53),
    numbers,
    words,
    st.lists(numbers, max_size=4),
    st.lists(st.lists(numbers, max_size=2), max_size=3),
)


@given(words, words, st.lists(words, max_size=4), st.dictionaries(words, values, max_size=4), numbers)
def test_a_request_comes_back_as_it_went(
    name: str, source: str, robots: list[str], parameters: dict[str, messages.Value], stamp: float
) -> None:
    request = BehaviourRequest(
        id="1", behaviour=name, robots=tuple(robots), parameters=parameters, source=source, stamp_s=stamp
    )
    assert decode(encode(request), BehaviourRequest) == request


def test_every_message_is_frozen_and_names_its_version() -> None:
    kinds = [each for each in vars(messages).values() if isinstance(each, type) and issubclass(each, Message)]
    tags = [str(kind.__struct_config__.tag) for kind in kinds]
    assert len(kinds) > 15
    assert len(set(tags)) == len(tags)
    assert all(kind.__struct_config__.frozen and kind.__struct_config__.forbid_unknown_fields for kind in kinds)


@given(st.binary(max_size=200))
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        decode(data, Command)


def test_another_version_is_named() -> None:
    data = msgspec.msgpack.encode({"kind": "Command/9", "robot": "r1"})
    with pytest.raises(MessageError, match=r"'Command/9' where 'Command/1'.*update the older side"):
        decode(data, Command)


def test_an_unknown_field_is_named() -> None:
    data = msgspec.msgpack.encode({"kind": "StopRequest/1", "id": "x", "sneaky": 1})
    with pytest.raises(MessageError, match="sneaky"):
        decode(data, messages.StopRequest)


def test_a_swarm_name_is_one_plain_chunk() -> None:
    with pytest.raises(ConfigError, match="cannot name a swarm"):
        Keys("a/b")


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0, 6.28), st.floats(0, 1), st.floats(0.5, 5))
def test_cells_within_reach_hold_everybody_in_reach(
    x: float, y: float, angle: float, share: float, cell: float
) -> None:
    import math

    reach = 3.0
    other = (x + share * reach * math.cos(angle), y + share * reach * math.sin(angle))
    assert cell_of(*other, cell) in cells_within(x, y, reach, cell)
