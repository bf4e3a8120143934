"""Messages survive the wire; what is not ours is refused with a reason."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import inspect

from fullswarm import messages
from fullswarm.bus.codec import decode, encode
from fullswarm.errors import ConfigError, MessageError
from fullswarm.keys import Keys, cell_of, cells_within
from fullswarm.messages import FITS, BehaviourRequest, Command, Message
from tests.unit.wild import KINDS, Wild

words = st.text(max_size=20)
numbers = st.floats(allow_nan=False, allow_infinity=False)
stamps = st.floats(-1e10, 1e10)
values = st.one_of(
    st.booleans(),
    st.integers(-(2**53), 2**53),
    numbers,
    words,
    st.lists(numbers, max_size=4),
    st.lists(st.lists(numbers, max_size=2), max_size=3),
)


@given(words, words, st.lists(words, max_size=4), st.dictionaries(words, values, max_size=4), stamps)
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
    assert all(kind.__struct_config__.frozen for kind in kinds)
    assert [kind for kind in kinds if not kind.__struct_config__.forbid_unknown_fields] == [messages.Version]


@given(st.binary(max_size=200))
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        decode(data, Command)


def test_another_version_is_named() -> None:
    data = msgspec.msgpack.encode({"kind": "Command/9", "robot": "r1"})
    with pytest.raises(MessageError, match=r"'Command/9' where 'Command/1'.*update the older side"):
        decode(data, Command)


def test_an_unknown_field_is_named() -> None:
    data = msgspec.msgpack.encode({"kind": "StopRequest/2", "id": "x", "sneaky": 1})
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


def numbers_in(value: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield every number of a message with the name of the field it stands in."""
    if isinstance(value, float | int):
        yield name, value
    elif isinstance(value, msgspec.Struct):
        for field in value.__struct_fields__:
            yield from numbers_in(getattr(value, field), field)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from numbers_in(each, name)
    elif isinstance(value, dict):
        for each in value.values():
            yield from numbers_in(each, name)


MAY_BE_ANYTHING = {"parameters", "value", "columns", "totals"}
"""A parameter is refused with a reason by who would obey it; in a measurement a number that is not finite is none."""


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_what_decodes_is_finite(kind: type[Message]) -> None:
    wild = Wild(seed=1, misfits=0.3)
    taken = 0
    for _ in range(300):
        try:
            message = decode(wild.raw(kind), kind)
        except MessageError:
            continue
        taken += 1
        for field, number in numbers_in(message):
            assert field in MAY_BE_ANYTHING or math.isfinite(number), message
    assert taken > 5


def unbounded(info: Any, name: str) -> Iterator[str]:
    """Yield the fields of a type whose numbers state no range."""
    if isinstance(info, inspect.FloatType | inspect.IntType) and None in (info.le, info.gt if info.ge is None else 0):
        yield name
    for each in getattr(info, "fields", ()):
        yield from unbounded(each.type, each.name)
    for each in (*getattr(info, "types", ()), *getattr(info, "item_types", ())):
        yield from unbounded(each, name)
    for each in ("item_type", "key_type", "value_type"):
        if hasattr(info, each):
            yield from unbounded(getattr(info, each), name)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_number_states_its_range(kind: type[Message]) -> None:
    assert set(unbounded(inspect.type_info(kind), "")) <= MAY_BE_ANYTHING


STATES = messages.RobotStates(
    host="r1", sequence=1, stamp_s=1.0, robots=("r1",), x_m=(1.0,), y_m=(2.0,), heading_rad=(0.0,), speed_m_s=(0.1,),
    turn_rad_s=(0.0,), radius_m=(0.17,),
)  # fmt: skip
SEEN = messages.SeenObstacles(host="r1", rows=((1.0, 2.0, 0.5, 0.5, 0.0, 0.0),), stamp_s=1.0)
COMMAND = Command(
    robot="r1", request_id="q", linear_m_s=0.1, angular_rad_s=0.0, ttl_s=0.3, sequence=1, stamp_s=1.0
)  # fmt: skip
FIX = messages.PoseFix(
    robot="r1", x_m=1.0, y_m=1.0, heading_rad=0.0, position_sigma_m=0.1, heading_sigma_rad=0.1, source="s", stamp_s=1.0
)  # fmt: skip
CONTROL = messages.ControlRequest(request_id="q", robot="r1", behaviour="b", enable=True)


@pytest.mark.parametrize(
    ("message", "field", "value"),
    [
        (STATES, "x_m", (math.nan,)),
        (STATES, "y_m", (1e8,)),
        (STATES, "speed_m_s", (math.inf,)),
        (STATES, "radius_m", (0.0,)),
        (STATES, "radius_m", (101.0,)),
        (STATES, "stamp_s", math.nan),
        (SEEN, "rows", ((1.0, 2.0, math.nan, 0.5, 0.0, 0.0),)),
        (SEEN, "rows", ((1.0, 2.0, 1e308, 0.5, 0.0, 0.0),)),
        (SEEN, "rows", ((1.0, 2.0, -0.5, 0.5, 0.0, 0.0),)),
        (COMMAND, "linear_m_s", math.nan),
        (COMMAND, "angular_rad_s", -math.inf),
        (COMMAND, "ttl_s", math.nan),
        (COMMAND, "ttl_s", 1e6),
        (COMMAND, "ttl_s", -1.0),
        (FIX, "x_m", math.nan),
        (FIX, "heading_rad", math.inf),
        (FIX, "position_sigma_m", -1.0),
        (FIX, "stamp_s", math.nan),
        (CONTROL, "expires_s", math.nan),
        (CONTROL, "expires_s", -1.0),
        (CONTROL, "expires_s", 1e9),
    ],
)
def test_a_number_that_cannot_be_is_refused_and_named(message: Message, field: str, value: object) -> None:
    assert decode(encode(message), type(message)) == message
    wild = msgspec.structs.replace(message, **{field: value})
    with pytest.raises(MessageError, match=rf"\$\.{field}"):
        decode(encode(wild), type(message))


COLUMNS = [kind for kind in FITS if "robots" in kind.__struct_fields__]


@pytest.mark.parametrize("kind", COLUMNS, ids=lambda kind: kind.__name__)
def test_columns_of_different_length_are_refused(kind: type[Message]) -> None:
    wild = Wild(seed=3, misfits=0.0)
    message = next(
        each
        for each in (wild.message(kind) for _ in range(1000))
        if len(each.robots) > 1  # type: ignore[attr-defined]
        and all(getattr(each, name) for name in each.__struct_fields__ if isinstance(getattr(each, name), tuple))
    )
    columns = set(message.__struct_fields__) - {"received"}  # of others: no column
    for field in (each for each in sorted(columns) if isinstance(getattr(message, each), tuple)):
        shorter = msgspec.structs.replace(message, **{field: getattr(message, field)[1:]})
        with pytest.raises(MessageError, match="columns of different length"):
            decode(encode(shorter), kind)


@pytest.mark.parametrize(("x", "y"), [(5, 6), (6, 5), (5, 5), (7, 7), (0, 0)])
def test_a_grid_with_other_points_than_its_cells_have_is_refused(x: int, y: int) -> None:
    mesh = messages.FloorMesh(
        columns=2, rows=1, x_m=(0.0,) * 6, y_m=(None,) * 6, eye_m=(0.0, 0.0, 3.0), tops_m=0.1
    )  # fmt: skip
    picture = messages.CameraPicture(camera="ceiling", jpeg=b"", mesh=mesh)
    assert decode(encode(picture), messages.CameraPicture) == picture
    wrong = msgspec.structs.replace(mesh, x_m=(0.0,) * x, y_m=(0.0,) * y)
    with pytest.raises(MessageError, match="columns of different length"):
        decode(encode(msgspec.structs.replace(picture, mesh=wrong)), messages.CameraPicture)


def test_a_message_of_many_megabytes_is_not_even_looked_at() -> None:
    with pytest.raises(MessageError, match="bytes, more than"):
        decode(encode(messages.StopRequest(id="x" * 5_000_000)), messages.StopRequest)
