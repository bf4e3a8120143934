"""The bus on a secured hub: who is admitted, what is refused and why, and that the hub's list can change."""

from __future__ import annotations

import datetime as dt
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from fullswarm.bus.codec import LARGEST_BYTES, encode
from fullswarm.bus.hub import Hub
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.identity import Credentials
from fullswarm.identity.access import ACCESS_KEY
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    Command,
    EStop,
    HealthReport,
    Heartbeat,
    LeaseRequest,
    Message,
    Reception,
    RobotHealth,
    RobotStates,
)
from fullswarm.runtime import Mailbox
from tests.certificates import HOUR, Authority, grant_of
from tests.unit.secured_hub import SecuredHub, free_port

DEADLINE_S = 5.0
REFUSED_S = 0.6
"""How long a client that must be refused tries."""
KEYS = Keys("test")
BLOCK = zenoh.CongestionControl.BLOCK
CORE_BEAT = Heartbeat(node="core", process="x", sequence=1)


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredHub]:
    made = SecuredHub(tmp_path_factory.mktemp("keys"))
    with made.hub:
        yield made


class Receiver:
    """A bus that keeps what arrives on some keys."""

    def __init__(self, secured: SecuredHub, name: str, *wanted: tuple[str, type[Message]]) -> None:
        self.mailbox = Mailbox()
        self.bus = secured.bus(name, self.mailbox)
        self.got: list[Message] = []
        for expression, kind in wanted:
            self.bus.subscribe(expression, kind, self.got.append)
        self.bus.wait_connected(DEADLINE_S)

    def until(self, condition: Callable[[], bool], repeat: Callable[[], object] = lambda: None) -> None:
        end_s = time.monotonic() + DEADLINE_S
        while not condition():
            repeat()
            self.mailbox.deliver_one(0.02)
            assert time.monotonic() < end_s, "nothing more came"


def states(robot: str, host: str) -> RobotStates:
    zero = (0.0,)
    return RobotStates(host=host, sequence=1, stamp_s=0.0, robots=(robot,), x_m=zero, y_m=zero, heading_rad=zero,
                       speed_m_s=zero, turn_rad_s=zero, radius_m=(0.2,))  # fmt: skip


def command(robot: str) -> Command:
    return Command(robot=robot, request_id="q", linear_m_s=0.1, angular_rad_s=0.0, ttl_s=0.5, sequence=1, stamp_s=0.0)


def report(host: str, robot: str) -> HealthReport:
    health = RobotHealth(robot=robot, driver="null://", make="", model="", firmware="", lifecycle="READY")
    return HealthReport(host=host, process="p", version="1", robots=(health,))


def request(operator: str) -> BehaviourRequest:
    return BehaviourRequest(id="q1", behaviour="stop", operator=operator)


# ---------------------------------------------------------------- who says what
FORGED = {
    "a state of another robot, under its host": ("r1", KEYS.state("all", "r2"), states("r2", "r2")),
    "a state of another robot, under the own key": ("r1", KEYS.state("all", "r1"), states("r2", "r2")),
    "another robot in the columns of an own state": ("r1", KEYS.state("all", "r1"), states("r2", "r1")),
    "another robot in an own health report": ("r1", KEYS.health("r1"), report("r1", "r2")),
    "a command of a robot": ("r1", KEYS.command("r2"), command("r2")),
    "a heartbeat of the core by a robot": ("r1", KEYS.heartbeat("core"), CORE_BEAT),
    "a heartbeat of the core by the world": ("world", KEYS.heartbeat("core"), CORE_BEAT),
    "a heartbeat of the core under the world's key": ("world", KEYS.heartbeat("world"), CORE_BEAT),
    "an e-stop's release by a robot": ("r1", KEYS.estop, EStop(id="e", engaged=False)),
    "an e-stop's release by the core": ("core", KEYS.estop, EStop(id="e", engaged=False)),
    "an e-stop's release by an observer": ("eve", KEYS.estop, EStop(id="e", engaged=False)),
    "a request in another operator's name": ("anna", KEYS.behaviour_request, request("bert@lab1")),
    "a request of an observer": ("eve", KEYS.behaviour_request, request("eve@lab1")),
    "a lease for another operator": (
        "anna", KEYS.lease_request, LeaseRequest(operator="bert@lab1", robots=("r1",), hold=True, take=True)
    ),
}  # fmt: skip


def test_what_a_sender_may_not_say_arrives_nowhere(secured: SecuredHub) -> None:
    everything: tuple[tuple[str, type[Message]], ...] = (
        (KEYS.state(), RobotStates), (KEYS.health(), HealthReport), (KEYS.heartbeat(), Heartbeat), (KEYS.estop, EStop),
        (KEYS.behaviour_request, BehaviourRequest), (KEYS.lease_request, LeaseRequest),
    )  # fmt: skip
    receivers = [Receiver(secured, "core", *everything), Receiver(secured, "console", *everything)]
    receivers.append(Receiver(secured, "r2", (KEYS.state(), RobotStates), (KEYS.estop, EStop),
                              (KEYS.command("r2"), Command), (KEYS.heartbeat("core"), Heartbeat)))  # fmt: skip
    receivers.append(Receiver(secured, "eve", *everything, (KEYS.command(), Command)))
    senders = {name: secured.bus(name) for name in ("r1", "core", "world", "anna", "eve", "console")}
    allowed: list[tuple[str, str, Message]] = [
        ("r1", KEYS.state("all", "r1"), states("r1", "r1")),
        ("core", KEYS.command("r2"), command("r2")),
        ("core", KEYS.estop, EStop(id="f", engaged=True)),
        ("anna", KEYS.estop, EStop(id="g", engaged=False)),
        ("anna", KEYS.behaviour_request, request("anna@lab1")),
        ("console", KEYS.behaviour_request, request("bert@lab1")),
    ]
    wanted = {encode(message) for _, _, message in allowed}
    for bus in senders.values():
        bus.wait_connected(DEADLINE_S)
    for name, key, message in [*FORGED.values(), *allowed]:
        senders[name].publish(key, message)
    # All of one kind are in order: the last allowed one of each sender comes after what it forged.
    for receiver, count in zip(receivers, (4, 5, 4, 6), strict=True):

        def repeat() -> None:
            for name, key, message in allowed:
                senders[name].publish(key, message)

        receiver.until(lambda: len({encode(each) for each in receiver.got}) >= count, repeat)  # noqa: B023
    for receiver in receivers:
        assert {encode(each) for each in receiver.got} <= wanted
        receiver.bus.close()
    for bus in senders.values():
        bus.close()


def test_what_others_have_sent_cannot_be_sent_again_by_who_recorded_it(secured: SecuredHub) -> None:
    originals: list[tuple[str, str, Message]] = [
        ("anna", KEYS.estop, EStop(id="once", engaged=False)),
        ("anna", KEYS.behaviour_request, request("anna@lab1")),
        ("core", KEYS.command("r2"), command("r2")),
    ]
    core = Receiver(secured, "core", (KEYS.estop, EStop), (KEYS.behaviour_request, BehaviourRequest))
    r2 = Receiver(secured, "r2", (KEYS.estop, EStop), (KEYS.command("r2"), Command))
    senders = {"anna": secured.bus("anna"), "core": secured.bus("core")}
    recorded: list[tuple[str, bytes]] = []
    with secured.session("eve") as eve, secured.session("r1") as robot, secured.session("camera") as camera:

        def keep(sample: zenoh.Sample) -> None:
            recorded.append((str(sample.key_expr), sample.payload.to_bytes()))

        record = zenoh.handlers.Callback(keep, indirect=False)
        for key in ("estop", "behaviour/request", "robot/*/command"):
            eve.declare_subscriber(f"test/*/{key}", record, allowed_origin=zenoh.Locality.REMOTE)
        for bus in senders.values():
            bus.wait_connected(DEADLINE_S)

        def settle() -> None:
            senders["anna"].publish(KEYS.estop, EStop(id="settle", engaged=False))
            senders["anna"].publish(KEYS.behaviour_request, request("anna"))
            senders["core"].publish(KEYS.command("r2"), command("r1"))  # refused by r2, recorded by eve

        core.until(
            lambda: len({type(each) for each in core.got}) == 2 and len({key for key, _ in recorded}) == 3, settle
        )
        r2.until(lambda: bool(r2.got) and r2.bus.dropped > 0, settle)
        for name, key, message in originals:
            senders[name].publish(key, message)
        core.until(lambda: all(message in core.got for _, _, message in originals[:2]))
        r2.until(lambda: all(message in r2.got for _, _, message in originals[::2]))
        r2.until(lambda: {encode(message) for _, _, message in originals} <= {payload for _, payload in recorded})
        for name, session in (("eve", eve), ("r1", robot), ("camera", camera)):
            for key, payload in set(recorded):
                for again in (key, "/".join(("test", name, *key.split("/")[2:]))):
                    session.put(again, payload, congestion_control=BLOCK)
            assert list(session.get(ACCESS_KEY, timeout=1.0))  # the hub has seen all that was before it on the link
        last = EStop(id="last", engaged=False)
        senders["anna"].publish(KEYS.estop, last)
        for receiver in (core, r2):
            receiver.until(lambda: last in receiver.got)  # noqa: B023
            assert all(receiver.got.count(message) <= 1 for _, _, message in originals)
    for bus in (*senders.values(), core.bus, r2.bus):
        bus.close()


def test_a_message_that_does_not_fit_its_sender_is_counted_and_logged_once(
    secured: SecuredHub, capsys: pytest.CaptureFixture[str]
) -> None:
    core = Receiver(secured, "core", (KEYS.reception(), Reception))
    with secured.session("r1") as robot:
        forged = encode(Reception(host="r2", robots=("r2",), x_m=(0.0,), y_m=(0.0,)))
        core.until(lambda: core.bus.dropped >= 5, lambda: robot.put("test/r1/reception/r1", forged))
    core.bus.close()
    assert not core.got
    logged = [line for line in capsys.readouterr().out.splitlines() if "test/r1/reception/r1" in line]
    assert len(logged) == 1
    assert "host is 'r2' in the message and 'r1' in its key" in logged[0]


def test_the_certificate_is_the_sender_whatever_the_program_says(secured: SecuredHub) -> None:
    seen: list[str] = []
    mailbox = Mailbox()
    core, anna = secured.bus("core", mailbox), secured.bus("anna")
    core.subscribe_with_sender(KEYS.estop, EStop, lambda got: seen.append(got.sender))
    for bus in (core, anna):
        bus.wait_connected(DEADLINE_S)
    end_s = time.monotonic() + DEADLINE_S
    while not seen:
        anna.publish(KEYS.estop, EStop(id="e", engaged=True), sender="core")
        mailbox.deliver_one(0.02)
        assert time.monotonic() < end_s
    assert set(seen) == {"anna"}
    core.close()
    anna.close()


def test_an_oversized_message_stops_at_the_hub(secured: SecuredHub) -> None:
    core = Receiver(secured, "core", (KEYS.reception(), Reception))
    good = encode(Reception(host="r1", robots=("r1",), x_m=(0.0,), y_m=(0.0,)))
    with secured.session("r1") as robot:
        core.until(lambda: bool(core.got), lambda: robot.put("test/r1/reception/r1", good))
        before = len(core.got)
        for _ in range(3):
            robot.put("test/r1/reception/r1", b"\xc0" * (LARGEST_BYTES + 1), congestion_control=BLOCK)
        core.until(lambda: len(core.got) > before, lambda: robot.put("test/r1/reception/r1", good))
    assert core.bus.dropped == 0
    core.bus.close()


# ---------------------------------------------------------------- who gets in
def refused(hub: str, credentials: Credentials | None) -> str:
    """Return the error of a client that tries to connect and must not."""
    with pytest.raises((Unreachable, ConfigError)) as caught:
        _connect(hub, credentials)
    return str(caught.value)


def _connect(hub: str, credentials: Credentials | None) -> None:
    bus = ZenohBus(Mailbox(), hub=hub, credentials=credentials)
    try:
        bus.wait_connected(REFUSED_S)
    finally:
        bus.close()


def test_each_reason_for_not_getting_in_is_named(secured: SecuredHub, tmp_path: Path) -> None:
    hub, own = secured.hub.endpoint, secured.authority
    other = Authority(tmp_path / "other", "another fleet")
    mixed = other.issue("r1", "robot")
    assert "this program has no certificate" in refused(hub, None)
    assert "has expired" in refused(hub, own.issue("r1", "robot", generation=2, ends=-dt.timedelta(minutes=1)))
    early = refused(hub, own.issue("r1", "robot", generation=3, starts=HOUR))
    assert "is not valid yet" in early
    assert "set the clock" in early
    assert "the hub's certificate is of another authority" in refused(hub, mixed)
    foreign = Credentials("r1", "robot", own.certificate, mixed.certificate, mixed.key)
    assert "is not of the authority in" in refused(hub, foreign)
    assert "list of valid certificates does not have that of 'r9'" in refused(hub, own.issue("r9", "robot"))
    r1 = secured.identities["r1"]
    assert "the private key of 'r1' is missing" in refused(
        hub, Credentials("r1", "robot", r1.authority, r1.certificate, tmp_path / "no.key")
    )
    assert "cannot be used" in refused(
        hub, Credentials("r1", "robot", r1.authority, r1.certificate, secured.identities["r2"].key)
    )
    assert "this hub is secured" in refused(hub.replace("tls/", "tcp/"), None)


def test_a_hub_under_another_name_is_not_trusted(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    robot = authority.issue("r1", "robot")
    own = authority.issue("hub", "hub", hosts=("base.lab",))
    with Hub(f"tls/127.0.0.1:{free_port()}", credentials=own, swarm="test", grants=(grant_of(robot),)) as hub:
        assert "the hub's certificate is not for '127.0.0.1'" in refused(hub.endpoint, robot)


def test_a_hub_whose_certificate_has_expired_is_not_trusted(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    robot = authority.issue("r1", "robot")
    own = authority.issue("hub", "hub", ends=-dt.timedelta(minutes=1))
    with Hub(f"tls/127.0.0.1:{free_port()}", credentials=own, swarm="test", grants=(grant_of(robot),)) as hub:
        assert "the hub's certificate has expired" in refused(hub.endpoint, robot)


def test_a_robots_certificate_does_not_make_a_hub(secured: SecuredHub) -> None:
    r1, r2 = secured.identities["r1"], secured.identities["r2"]
    with Hub(f"tls/127.0.0.1:{free_port()}", credentials=r2, swarm="test", grants=secured.grants()) as hub:
        assert "the hub's certificate is" in refused(hub.endpoint, r1)


def test_a_program_at_the_port_that_is_no_secured_hub_is_named(tmp_path: Path) -> None:
    robot = Authority(tmp_path).issue("r1", "robot")
    with socket.create_server(("127.0.0.1", 0)) as other:
        hub = f"tls/127.0.0.1:{other.getsockname()[1]}"
        assert "does not answer as a secured hub" in refused(hub, robot)


def test_where_no_hub_is_the_error_says_that_none_answers(tmp_path: Path) -> None:
    robot = Authority(tmp_path).issue("r1", "robot")
    assert "no hub answers" in refused(f"tls/127.0.0.1:{free_port()}", robot)


def test_a_secured_hub_needs_a_certificate() -> None:
    with pytest.raises(ConfigError, match="fullswarm keys init"):
        Hub("tls/127.0.0.1:7447")


def test_silent_clients_of_the_port_keep_nobody_out(secured: SecuredHub) -> None:
    host, port = "127.0.0.1", int(secured.hub.endpoint.rpartition(":")[2])
    sockets = [socket.create_connection((host, port)) for _ in range(100)]
    try:
        started_s = time.monotonic()
        bus = secured.bus("r1")
        bus.wait_connected(DEADLINE_S)
        bus.close()
        assert time.monotonic() - started_s < 2.0
    finally:
        for each in sockets:
            each.close()


# ---------------------------------------------------------------- the hub's list changes
def test_a_revoked_certificate_ends_and_all_others_come_back(tmp_path: Path) -> None:
    secured = SecuredHub(tmp_path)
    with secured.hub:
        core = Receiver(secured, "core", (KEYS.reception(), Reception))
        robots = {name: secured.bus(name) for name in ("r1", "r2")}
        for bus in robots.values():
            bus.wait_connected(DEADLINE_S)

        def publish() -> None:
            for name, bus in robots.items():
                bus.publish(KEYS.reception(name), Reception(host=name, robots=(name,), x_m=(0.0,), y_m=(0.0,)))

        core.until(lambda: len(hosts(core.got)) == 2, publish)
        secured.hub.reopen(secured.grants("r2"))  # it closes every link: what r2 sent before is in the mailbox by then
        while core.mailbox.deliver_one(0.0):
            pass
        core.got.clear()
        core.until(lambda: len(core.got) > 20 and core.bus.connected(), publish)
        assert hosts(core.got) == {"r1"}
        assert not robots["r2"].connected()
        with pytest.raises(Unreachable, match="it was revoked"):
            robots["r2"].wait_connected(REFUSED_S)
        secured.hub.reopen(secured.grants())
        core.until(lambda: hosts(core.got) == {"r1", "r2"}, publish)
        for bus in (*robots.values(), core.bus):
            bus.close()


def hosts(messages: list[Message]) -> set[str]:
    return {each.host for each in messages if isinstance(each, Reception)}


def test_a_certificate_that_was_renewed_on_disk_is_used_when_the_old_one_ends(tmp_path: Path) -> None:
    """With the old one the link would end for good, as in the test below."""
    secured = SecuredHub(tmp_path)
    issued_s = time.monotonic()
    short = secured.authority.issue("r1", "robot", ends=dt.timedelta(seconds=3))
    with secured.hub:
        bus = ZenohBus(Mailbox(), hub=secured.hub.endpoint, credentials=short)
        bus.wait_connected(DEADLINE_S)
        secured.authority.issue("r1", "robot")  # the same files
        threading.Event().wait(issued_s + 4.5 - time.monotonic())
        bus.wait_connected(DEADLINE_S)
        bus.close()


def test_a_certificate_that_expires_ends_its_link(tmp_path: Path) -> None:
    secured = SecuredHub(tmp_path)
    short = secured.authority.issue("r1", "robot", generation=7, ends=dt.timedelta(seconds=3))
    secured.hub.reopen((*secured.grants(), grant_of(short, 7)))
    try:
        bus = ZenohBus(Mailbox(), hub=secured.hub.endpoint, credentials=short)
        bus.wait_connected(DEADLINE_S)
        end_s = time.monotonic() + 10.0
        gone = threading.Event()
        while bus.connected():
            gone.wait(0.05)
            assert time.monotonic() < end_s, "it is still connected"
        with pytest.raises(Unreachable, match="has expired"):
            bus.wait_connected(REFUSED_S)
        bus.close()
    finally:
        secured.hub.close()
