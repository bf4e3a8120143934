"""Who may publish and receive what: every key and every role, at a real hub with real certificates."""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from fullswarm.identity import Grant
from fullswarm.identity.access import ACCESS_KEY, OWN, TOPICS, Rights, rules, table, topic_of
from fullswarm.keys import ANY, TRUTH, Keys
from tests.unit.secured_hub import NAMES, SecuredHub

DEADLINE_S = 10.0
DOCUMENT = Path(__file__).parents[2] / "docs" / "explanation-who-may-what.md"


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredHub]:
    made = SecuredHub(tmp_path_factory.mktemp("keys"))
    with made.hub:
        yield made


def all_keys() -> dict[str, str]:
    """Return every key expression of `Keys`, by the name of its method or property."""
    keys, found = Keys("test"), {}
    for name, member in inspect.getmembers(Keys):
        if isinstance(member, property):
            found[name] = getattr(keys, name)
        elif inspect.isfunction(member) and not name.startswith("_"):
            wanted = inspect.signature(member).parameters.values()
            required = [ANY for each in wanted if each.default is each.empty and each.name != "self"]
            found[name] = getattr(keys, name)(*required)
    return found


# ---------------------------------------------------------------- the table
def test_every_key_of_the_bus_has_its_rights_and_nothing_else_has() -> None:
    keys = {name: key.partition("/")[2] for name, key in all_keys().items()}
    patterns = {topic.expression() for topic in TOPICS}
    assert set(keys.values()) == patterns
    assert len(patterns) == len(TOPICS)


def test_every_chunk_in_angle_brackets_is_a_field_of_the_message() -> None:
    for topic in TOPICS:
        for message in topic.messages:
            assert {name for _, name in topic.fields} <= set(message.__struct_fields__), topic.key


def test_a_right_that_depends_on_a_name_has_a_chunk_for_it() -> None:
    for topic in TOPICS:
        assert topic.fields or {*topic.publish.values(), *topic.receive.values()} <= {ANY}, topic.key


def test_a_topic_is_found_by_its_key() -> None:
    for topic in TOPICS:
        assert topic_of(topic.expression("r1").replace(ANY, "x")) is topic
    assert topic_of("state/all") is None
    assert topic_of("robot/r1/behaviour/x/command") is None


def test_only_people_and_the_core_stop_robots_and_no_robot_commands_another() -> None:
    rights = {topic.key: set(topic.publish) for topic in TOPICS}
    assert rights["stop"] == {"operator", "console"}
    assert rights["estop"] == {"operator", "console", "core"}
    assert rights["robot/<robot>/command"] == rights["lease/holders"] == {"core"}
    assert rights["params/*/request"] == rights["lease/request"] == {"operator", "console"}
    assert not any("hub" in roles for roles in rights.values())
    assert [key for key, roles in rights.items() if "observer" in roles] == ["identity/<name>/renew"]


def test_each_certificate_is_a_subject_and_no_other_is() -> None:
    grants = (Grant("r1.1", "r1", "robot"), Grant("r1.2", "r1", "robot"), Grant("cam.1", "cam", "source"))
    made = rules("test", grants)
    assert made["default_permission"] == "deny"
    listed = made["rules"]
    assert isinstance(listed, list)
    keys = {each["id"]: each["key_exprs"] for each in listed}
    for name in ("r1.1", "r1.2", "cam.1"):
        assert keys[f"{name}-subscribe"] == keys[f"{name}-receive"]
        assert not any("**" in key for rule in ("publish", "receive") for key in keys[f"{name}-{rule}"])
    assert {each["id"] for each in listed if "put" in each["messages"]} == {
        f"{name}-{rule}" for name in ("r1.1", "r1.2", "cam.1") for rule in ("publish", "receive")
    }
    assert made["subjects"] == [{"id": each, "cert_common_names": [each]} for each in ("r1.1", "r1.2", "cam.1")]


def test_the_page_shows_the_table() -> None:
    assert table() in DOCUMENT.read_text()


# ---------------------------------------------------------------- at a hub
def allowed(rights: Rights, name: str, chunk: str) -> bool:
    """Tell from the table, not from the access list made of it, whether `name` may use `chunk`."""
    right = rights.get(NAMES[name])
    return right is not None and (right == ANY or chunk == (name if right == OWN else right))


CHUNKS = ("r1", "r2", "core", "centralised", "world", TRUTH)
"""What stands in the restricted chunk of keys in the test: own names, those of others, and of no process."""

ENDS = (("core", "estop"), ("core", "behaviour/x/control_request"), ("anna", "estop"), ("anna", "world/hold"),
        ("r1", "health/r1"))  # fmt: skip
"""Published at the end, by those who may: each identity receives one of them after all that came before."""


def test_each_key_is_published_and_received_by_those_who_may_and_no_others(secured: SecuredHub) -> None:
    """Every role publishes every key under its own and another name, and subscribes to every key in three ways."""
    got: set[tuple[str, str, str]] = set()  # receiver, key, publisher
    markers: set[str] = set()
    lock = threading.Lock()
    concrete = [
        (topic, chunk, topic.expression(chunk).replace(ANY, "x"))
        for topic in TOPICS
        for chunk in (CHUNKS if topic.fields else ("",))
    ]
    with ExitStack() as stack:
        sessions = {name: stack.enter_context(secured.session(name)) for name in NAMES}
        for name, session in sessions.items():

            def received(sample: zenoh.Sample, name: str = name) -> None:
                with lock:
                    if sample.payload.to_bytes() == b"end":
                        markers.add(name)
                    else:
                        got.add((name, str(sample.key_expr), sample.payload.to_string()))

            callback = zenoh.handlers.Callback(received, indirect=False)
            expressions = {topic.expression(chunk) for topic in TOPICS for chunk in (ANY, *CHUNKS)} | {"**"}
            for expression in expressions:
                session.declare_subscriber(f"test/*/{expression}", callback, allowed_origin=zenoh.Locality.REMOTE)
        for name, session in sessions.items():
            assert _admitted(session), name
        expected: set[tuple[str, str, str]] = set()
        for name, session in sessions.items():
            for topic, chunk, rest in concrete:
                for sender in (name, "core" if name != "core" else "r1", "r2" if name != "r2" else "anna"):
                    key = f"test/{sender}/{rest}"
                    session.put(key, name, congestion_control=zenoh.CongestionControl.BLOCK)
                    session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)  # never passed on
                    if sender == name and allowed(topic.publish, name, chunk):
                        others = (each for each in NAMES if each != name)
                        expected |= {(each, key, name) for each in others if allowed(topic.receive, each, chunk)}
            assert _admitted(session)  # the hub has seen all that was before this query on the link
        for name, rest in ENDS:
            sessions[name].put(f"test/{name}/{rest}", "end", congestion_control=zenoh.CongestionControl.BLOCK)
        end_s = time.monotonic() + DEADLINE_S
        while markers != set(NAMES):
            time.sleep(0.005)
            assert time.monotonic() < end_s, set(NAMES) - markers
    assert got == expected
    assert {receiver for receiver, _, _ in got} == set(NAMES)
    assert {publisher for _, _, publisher in got} == set(NAMES) - {"eve"}


def test_nobody_queries_answers_or_watches_anything_else(secured: SecuredHub) -> None:
    seen: list[str] = []

    def reply(query: zenoh.Query) -> None:
        query.reply("test/core/heartbeat/core", b"x")

    def watched(sample: zenoh.Sample) -> None:
        seen.append(str(sample.key_expr))

    answer = zenoh.handlers.Callback(reply, indirect=False)
    watch = zenoh.handlers.Callback(watched, indirect=False)
    with secured.session("core") as core, secured.session("r1") as robot, secured.session("anna") as anna:
        for session in (core, robot):
            session.declare_queryable("test/**", answer)
            session.liveliness().declare_token("test/core/alive")
        anna.liveliness().declare_subscriber("**", watch, history=True)
        assert _admitted(robot)
        assert _admitted(anna)
        for key in ("test/**", "**", "test/core/heartbeat/core"):
            assert not list(anna.get(key, timeout=0.5)), key
            assert not list(anna.liveliness().get(key, timeout=0.5)), key
        own = f"@/{anna.zid()}/"
        assert all(str(each.ok.key_expr).startswith(own) for each in anna.get("@/**", timeout=0.5) if each.ok)
    assert not seen


def _admitted(session: zenoh.Session) -> bool:
    return any(reply.ok is not None for reply in session.get(ACCESS_KEY, timeout=5.0))
