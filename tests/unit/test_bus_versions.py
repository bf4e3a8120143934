"""Processes of different releases find each other, and no robot drives among robots whose states it cannot read."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from fullswarm import messages
from fullswarm.bus.codec import decode, encode
from fullswarm.bus.local import LocalBus
from fullswarm.bus.versions import GONE_S, VersionWatch, difference
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.messages import ControlRequest, Message, Version, versions
from fullswarm.reasons import NONE, Code, Reason
from fullswarm.runtime import Runtime

OLDER = {**versions(), "RobotStates": 2}


class Pair:
    """Two processes on one bus, the second of another release."""

    def __init__(self, theirs: dict[str, int]) -> None:
        self.runtime = Runtime(SimClock())
        bus = LocalBus(self.runtime.mailbox)
        self.seen: list[Reason] = []
        self.own = VersionWatch(bus, Keys(), self.runtime, "r1", self.seen.append)
        self.other = VersionWatch(bus, Keys(), self.runtime, "r2", lambda _: None, theirs)


def test_a_process_of_another_release_is_named_with_what_differs_until_it_has_gone() -> None:
    pair = Pair(OLDER)
    pair.runtime.run(1.5)
    (why,) = pair.seen
    assert why.code == Code.VERSION
    assert "'r2'" in why.text
    assert f"RobotStates 2, here {versions()['RobotStates']}" in why.text
    assert pair.own.problem_of("r2") == why
    assert pair.own.problem_of("r3") == NONE
    pair.other.close()
    pair.runtime.run(GONE_S + 2.0)
    assert pair.seen == [why, NONE]
    assert pair.own.problem_of("r2") == NONE


@pytest.mark.parametrize("theirs", [versions(), {}, {**versions(), "Later": 1}])
def test_a_message_that_only_one_of_them_knows_is_no_reason(theirs: dict[str, int]) -> None:
    pair = Pair(theirs)
    pair.runtime.run(3.0)
    assert pair.seen == []


def test_the_announcement_is_read_whatever_later_releases_add_to_it() -> None:
    """The form that all releases share, as bytes: if this fails, older processes can no longer read it."""
    raw: Any = {"kind": "Version/1", "name": "r7", "software": "9.0", "kinds": {"RobotStates": 9}, "colour": "blue"}
    message = decode(msgspec.msgpack.encode(raw), Version)
    assert (message.name, message.software, message.kinds, message.stamp_s) == ("r7", "9.0", {"RobotStates": 9}, 0.0)
    sent = msgspec.msgpack.decode(encode(Version(name="r7", software="9.0", kinds={"RobotStates": 9})))
    assert {"kind", "name", "software", "kinds"} <= sent.keys()
    assert sent["kind"] == "Version/1"


def test_versions_are_those_of_the_tags() -> None:
    assert versions()["ControlRequest"] == int(str(ControlRequest.__struct_config__.tag).partition("/")[2])
    kinds = {each.__name__ for each in vars(messages).values() if isinstance(each, type) and issubclass(each, Message)}
    assert versions().keys() <= kinds


def test_many_differences_are_counted() -> None:
    other = Version(name="core", software="0.0.9", kinds=dict.fromkeys(versions(), 1_000))
    text = difference(other, versions()).text
    assert f"{len(versions()) - 3} more" in text
    assert len(text) < 400
