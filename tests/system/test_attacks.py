"""Attacks on a secured swarm of real processes: each is refused, logged by name, and leaves nothing behind.

One `fullswarm up` serves all of them. The attackers are bare sessions of zenoh with certificates of this swarm: what a
stolen robot, display or operator's computer has. After each attack an operator's request must work as before.
"""

from __future__ import annotations

import re
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh

from fullswarm.bus.codec import LARGEST_BYTES, encode
from fullswarm.bus.zenoh_bus import ZenohBus, client_config, untyped
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.identity import Credentials, Role
from fullswarm.identity.access import ACCESS_KEY, _receives
from fullswarm.identity.authority import Authority, copy_to, revoke
from fullswarm.identity.certificates import DAY_S
from fullswarm.identity.folder import IDENTITY, KeysFolder
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    CertificateRequest,
    Command,
    EStop,
    Heartbeat,
    Message,
    RequestStatus,
    RobotMeasurement,
    RobotStates,
    SeenObstacles,
    StopRequest,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime
from tests.system.test_secured_swarm import Lab

START_S, SOON_S = 60.0, 15.0
KEYS = Keys("lab")
BLOCK = zenoh.CongestionControl.BLOCK
THIEF = "r9"
"""A robot with a valid certificate that obeys nothing."""


class Attacked:
    """A secured swarm of two robots, an operator who uses it, and the certificates that attackers have."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.lab = Lab(folder)
        self.lab.environment["FULLSWARM_STATE"] = str(folder / "state")
        self.lab.run("keys", "init", str(self.lab.fleet))
        self.keys = KeysFolder.of("lab", folder / "identity")
        authority = Authority.open(self.keys)
        roles: dict[str, Role] = {THIEF: "robot", "gone": "robot", "eve": "observer", "watch": "observer"}
        for name, role in roles.items():
            authority.issue(name, role)
        Authority.open(self.keys, wall_s=lambda: time.time() - 40 * DAY_S).issue("late", "robot")
        self.late = copy_to(self.keys, "late", folder / "late").credentials("late", "robot")  # before it is renewed
        other = Authority.make(KeysFolder.of("lab", folder / "other")).issue("r1", "robot")[0]
        self.foreign = Credentials("r1", "robot", self.keys.authority_path, other.certificate, other.key)
        monkeypatch.setenv(IDENTITY, str(folder / "identity"))
        self.lab.start()
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self.bus = ZenohBus(self.runtime.mailbox, hub=self.lab.hub, credentials=self.keys.credentials("anna"))
        self.operator = Operator(self.bus, KEYS, self.runtime, "test", name="anna", clock=clock_id())
        self.view = FleetView(self.bus, KEYS, self.runtime, ("r1", "r2"))
        self.until(self.ready, "both robots are ready", START_S)
        found = re.search(r"logs in (\S+);", (folder / "up.log").read_text())
        assert found is not None
        self.logs = Path(found[1])
        assert "the hub refused" not in self.log("hub")  # a swarm that nobody attacks

    def close(self) -> None:
        self.operator.close()
        self.view.close()
        self.bus.close()
        self.lab.close()

    # ------------------------------------------------------------------ waiting and looking
    def until(self, condition: Callable[[], bool], what: str, within_s: float = SOON_S) -> None:
        end_s = time.monotonic() + within_s
        while not condition():
            self.runtime.run(0.02)
            assert time.monotonic() < end_s, f"{what}\n--- hub\n{self.log('hub')[-3000:]}"

    def ready(self) -> bool:
        rows = self.view.snapshot().robots
        states = [row.health.lifecycle for row in rows if row.robot in ("r1", "r2") and row.health and row.age_s < 1.0]
        return len(states) == 2 and set(states) <= {"READY", "ACTIVE"}

    def latched(self) -> set[str]:
        return {row.robot for row in self.view.snapshot().robots if row.health is not None and row.health.estop}

    def log(self, process: str) -> str:
        path = getattr(self, "logs", Path("none")) / f"{process}.log"
        return path.read_text() if path.exists() else ""

    def logged(self, process: str, *parts: str, again: Callable[[], object] = lambda: None) -> None:
        """Wait until one line of a process's log has all `parts`; call `again` meanwhile."""

        def is_there() -> bool:
            again()
            return any(all(part in line for part in parts) for line in self.log(process).splitlines())

        self.until(is_there, f"{process}.log names {parts}")

    def audited(self, act: str) -> list[str]:
        files = sorted((self.lab.folder / "state" / "audit").rglob("*.jsonl"))
        return [entry for file in files for entry in file.read_text().splitlines() if f'"act":"{act}"' in entry]

    def works(self) -> None:
        """A request of an operator is accepted, and both robots confirm it."""
        seen: list[RequestStatus] = []
        self.operator.request("flocking_bc", ("r1", "r2"), {}, seen.append)
        self.until(
            lambda: bool(seen) and seen[-1].phase == "running" and set(seen[-1].running) == {"r1", "r2"},
            "a request of an operator works as before",
        )

    # ------------------------------------------------------------------ attacking
    @contextmanager
    def session(self, name: str) -> Iterator[zenoh.Session]:
        """Open a bare session with the certificate of `name`."""
        config = client_config(self.lab.hub, multicast=False, credentials=self.keys.credentials(name))
        session = zenoh.open(config)
        try:
            yield session
        finally:
            untyped(session.close)

    @contextmanager
    def nothing_of(self, name: str) -> Iterator[None]:
        """Check that no message of `name` gets through to an observer, who receives nearly all there is."""
        got: list[str] = []

        def keep(sample: zenoh.Sample) -> None:
            got.append(str(sample.key_expr))

        take = zenoh.handlers.Callback(keep, indirect=False)
        with self.session("watch") as watch:
            for expression in _receives("lab", "watch", "observer"):
                watch.declare_subscriber(expression, take)
            assert list(watch.get(ACCESS_KEY, timeout=5.0))
            yield
            self.until(lambda: len(got) > 20, "the observer receives the swarm")
        assert not [key for key in got if key.split("/")[1] == name]


@pytest.fixture(scope="module")
def swarm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Attacked]:
    with pytest.MonkeyPatch.context() as monkeypatch, ExitStack() as closing:
        made = Attacked(tmp_path_factory.mktemp("attacked"), monkeypatch)
        closing.callback(made.close)
        made.works()
        yield made


@pytest.fixture(autouse=True)
def _as_before(swarm: Attacked) -> Iterator[None]:
    """Each attack has no lasting effect: not on requests, not on the processes, not on a latch."""
    yield
    swarm.works()
    assert swarm.lab.up is not None
    assert swarm.lab.up.poll() is None
    assert "it is started again" not in (swarm.lab.folder / "up.log").read_text()
    assert not swarm.latched()


def put(session: zenoh.Session, *messages: tuple[str, Message | bytes]) -> None:
    """Send messages, and wait until the hub has dealt with them."""
    for key, message in messages:
        payload = message if isinstance(message, bytes) else encode(message)
        session.put(key, payload, congestion_control=BLOCK)
    assert list(session.get(ACCESS_KEY, timeout=5.0))


def states(robot: str, host: str, sequence: int = 1) -> RobotStates:
    zero = (0.0,)
    return RobotStates(host=host, sequence=sequence, stamp_s=0.0, robots=(robot,), x_m=zero, y_m=zero,
                       heading_rad=zero, speed_m_s=zero, turn_rad_s=zero, radius_m=(0.2,))  # fmt: skip


def measured(host: str, robot: str, value: float) -> RobotMeasurement:
    return RobotMeasurement(host=host, process="p", robots=(robot,), columns={"work_m": (value,)}, stamp_s=0.0)


# ---------------------------------------------------------------- who gets in
def test_without_a_certificate(swarm: Attacked) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    plain = socket.create_connection(("127.0.0.1", int(swarm.lab.hub.rpartition(":")[2])), 5.0)
    with plain, pytest.raises((ssl.SSLError, ConnectionError)), context.wrap_socket(plain) as link:
        link.recv(1)
    swarm.logged("hub", "the hub refused", "peer sent no certificates")
    with pytest.raises(zenoh.ZError):
        zenoh.open(client_config(swarm.lab.hub.replace("tls/", "tcp/"), multicast=False))
    swarm.logged("hub", "the hub refused", "connect: received corrupt message")


@pytest.mark.parametrize(("whose", "why"), [("late", "certificate expired"), ("foreign", "BadSignature")])
def test_with_an_expired_certificate_or_one_of_another_authority(swarm: Attacked, whose: str, why: str) -> None:
    credentials: Credentials = getattr(swarm, whose)
    with pytest.raises(zenoh.ZError):
        zenoh.open(client_config(swarm.lab.hub, multicast=False, credentials=credentials))
    swarm.logged("hub", "the hub refused", why)


def test_with_a_revoked_certificate(swarm: Attacked) -> None:
    with swarm.session("gone") as gone:
        put(gone, ("lab/gone/state/all/gone", states("gone", "gone")))
        revoke(swarm.keys, "gone")
        swarm.logged("hub", "the hub refused", "certificate=gone.", "not in the list of valid certificates")
        with swarm.nothing_of("gone"):
            for number in range(20):
                gone.put("lab/gone/state/all/gone", encode(states("gone", "gone", number)), congestion_control=BLOCK)
            assert not list(gone.get(ACCESS_KEY, timeout=0.5))
    swarm.until(swarm.ready, "both robots are back")


# ---------------------------------------------------------------- what the hub refuses by the key
STEER = Command(robot="r2", request_id="q", linear_m_s=1.0, angular_rad_s=0.0, ttl_s=5.0, sequence=1, stamp_s=0.0)
BEAT = Heartbeat(node="core", process="forged", sequence=1)
ASK = BehaviourRequest(id="forged", behaviour="flocking_bc", operator="anna")
BOX = SeenObstacles(host="r2", rows=((1.0, 1.0, 9.0, 9.0, 0.0, 0.0),), stamp_s=0.0)
HOLES: dict[str, tuple[str, str, Message | bytes]] = {
    "robot A as B": (THIEF, "lab/r2/state/all/r2", states("r2", "r2")),
    "robot A under B's key": (THIEF, f"lab/{THIEF}/state/all/r2", states("r2", "r2")),
    "a robot commands": (THIEF, f"lab/{THIEF}/robot/r2/command", STEER),
    "a robot commands as the core": (THIEF, "lab/core/robot/r2/command", STEER),
    "an observer requests": ("eve", "lab/eve/behaviour/request", ASK),
    "an observer stops": ("eve", "lab/eve/stop", StopRequest(id="forged", source="eve")),
    "a heartbeat of the core": (THIEF, "lab/core/heartbeat/core", BEAT),
    "a heartbeat of the core under the own name": (THIEF, f"lab/{THIEF}/heartbeat/core", BEAT),
    "ghosts under their own names": (THIEF, "lab/ghost1/state/all/ghost1", states("ghost1", "ghost1")),
    "obstacles of another robot": (THIEF, "lab/r2/obstacles/r2", BOX),
    "measurements of the truth": (THIEF, f"lab/{THIEF}/measurement/robots/truth", measured("truth", "r1", 9e9)),
    "another swarm": (THIEF, f"hall/{THIEF}/state/all/{THIEF}", states(THIEF, THIEF)),
    "a renewal for another name": (THIEF, f"lab/{THIEF}/identity/r2/renew", CertificateRequest(name="r2", request="")),
    "a key with a line break": (THIEF, "lab/r2/x\n2026 TRACE 1 is unauthorized to Put (ingress) on y", b""),
}  # fmt: skip


@pytest.mark.parametrize("attack", HOLES)
def test_a_key_that_its_certificate_does_not_allow(swarm: Attacked, attack: str) -> None:
    name, key, message = HOLES[attack]
    with swarm.nothing_of(name), swarm.session(name) as thief:
        put(thief, (key, message))
    swarm.logged("hub", "the hub refused", f"certificate={name}.", "tried=publish", key.split("\n")[0])


def test_an_observer_listens_where_it_may_not(swarm: Attacked) -> None:
    with swarm.session("eve") as eve:
        got: list[zenoh.Sample] = []
        eve.declare_subscriber("**", zenoh.handlers.Callback(got.append, indirect=False))
        eve.declare_subscriber("lab/*/params/*/request", zenoh.handlers.Callback(got.append, indirect=False))
        assert list(eve.get(ACCESS_KEY, timeout=5.0))
        assert not list(eve.get("@/*/router/**", timeout=0.3))
        swarm.works()
        assert not got
    swarm.logged("hub", "the hub refused", "certificate=eve.", "tried=receive", "lab/*/params/*/request")
    swarm.logged("hub", "the hub refused", "certificate=eve.", "tried=query", "@/*/router/**")


# ---------------------------------------------------------------- what receivers refuse by the contents
LIES: dict[str, tuple[str, Message | bytes, str]] = {
    "robot B in A's state": (f"state/all/{THIEF}", states("r2", "r2"), "host is 'r2' in the message"),
    "robot B in the columns of A's state": (f"state/all/{THIEF}", states("r2", THIEF), "reports the robot 'r2'"),
    "a ghost in A's state": (f"state/all/{THIEF}", states("ghost", THIEF), "reports the robot 'ghost'"),
    "a measurement of another robot": (
        f"measurement/robots/{THIEF}", measured(THIEF, "r1", 9e9), "reports the robot 'r1'"
    ),
    "a renewal for another name": (
        f"identity/{THIEF}/renew", CertificateRequest(name="r2", request=""), "name is 'r2' in the message"
    ),
    "no message at all": (f"state/all/{THIEF}", b"\xc1" * 64, "not MessagePack"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_message_that_is_not_its_senders(swarm: Attacked, lie: str) -> None:
    rest, message, why = LIES[lie]
    key, reader = f"lab/{THIEF}/{rest}", "r1" if rest.startswith("state") else "core"
    with swarm.session(THIEF) as thief:  # a receiver logs a key once per second, whatever the reason
        swarm.logged(reader, "message dropped", key, why, again=lambda: put(thief, (key, message)))
    assert not {"ghost", THIEF} & {row.robot for row in swarm.view.snapshot().robots}


def test_obstacles_in_the_name_of_another_robot(swarm: Attacked) -> None:
    key = f"lab/{THIEF}/obstacles/{THIEF}"
    with swarm.session(THIEF) as thief:
        put(thief, (key, BOX))
    for robot in ("r1", "r2"):
        swarm.logged(robot, "message dropped", key, "host is 'r2' in the message")


# ---------------------------------------------------------------- e-stops, replay
def test_a_forged_and_a_repeated_release_release_nothing(swarm: Attacked) -> None:
    recorded: dict[str, bytes] = {}

    def keep(sample: zenoh.Sample) -> None:
        recorded[str(sample.key_expr)] = sample.payload.to_bytes()

    with swarm.session("eve") as eve, swarm.session(THIEF) as thief:
        eve.declare_subscriber("lab/*/estop", zenoh.handlers.Callback(keep, indirect=False))
        assert list(eve.get(ACCESS_KEY, timeout=5.0))
        swarm.operator.estop(False, ("r1", "r2"))
        swarm.until(lambda: bool(recorded), "the observer has recorded a release")
        ((key, release),) = recorded.items()
        swarm.operator.estop(True, ("r1", "r2"))
        swarm.until(lambda: swarm.latched() == {"r1", "r2"}, "both robots are latched")
        forged = EStop(id="forged", engaged=False, clock=clock_id(), stamp_s=swarm.runtime.now_s())
        for name, session in (("eve", eve), (THIEF, thief)):
            put(session, (key, release), (f"lab/{name}/estop", release), (f"lab/{name}/estop", forged))
            swarm.logged("hub", "the hub refused", f"certificate={name}.", f"lab/{name}/estop")
            swarm.logged("hub", "the hub refused", f"certificate={name}.", key)
    with swarm.session("anna") as stolen:  # the hub passes on what an operator's own certificate repeats
        put(stolen, (key, release))
        for robot in ("r1", "r2"):
            swarm.logged(robot, "release ignored")
    assert swarm.latched() == {"r1", "r2"}
    assert not any('"forged"' in entry for entry in swarm.audited("estop_release"))
    swarm.operator.estop(False, ("r1", "r2"))
    swarm.until(lambda: not swarm.latched(), "both robots are released")


def test_a_request_that_is_sent_again_starts_nothing(swarm: Attacked) -> None:
    """A stop is newer than the request that an attacker has recorded and repeats."""
    recorded: list[tuple[str, bytes]] = []

    def keep(sample: zenoh.Sample) -> None:
        recorded.append((str(sample.key_expr), sample.payload.to_bytes()))

    with swarm.session("eve") as eve, swarm.session("anna") as stolen:
        eve.declare_subscriber("lab/*/behaviour/request", zenoh.handlers.Callback(keep, indirect=False))
        assert list(eve.get(ACCESS_KEY, timeout=5.0))
        swarm.works()
        swarm.until(lambda: bool(recorded), "the observer has recorded a request")
        key, request = recorded[-1]
        done: list[bool] = []
        swarm.operator.stop((), lambda: done.append(True))
        swarm.until(lambda: bool(done) and not moving(swarm), "both robots are stopped")
        put(eve, (key, request))
        swarm.logged("hub", "the hub refused", "certificate=eve.", key)
        swarm.logged("core", "request ignored", again=lambda: put(stolen, (key, request)))
        swarm.runtime.run(1.0)  # what must not happen has the time of many control periods
        assert not moving(swarm)


def moving(swarm: Attacked) -> set[str]:
    rows = swarm.view.snapshot().robots
    return {row.robot for row in rows if row.health is not None and (row.health.moving or row.health.behaviour)}


# ---------------------------------------------------------------- size and rate
def test_oversized(swarm: Attacked) -> None:
    key = f"lab/{THIEF}/reception/{THIEF}"
    with swarm.nothing_of(THIEF), swarm.session(THIEF) as thief:
        put(thief, (key, bytes(LARGEST_BYTES + 1)))
    swarm.logged("hub", "the hub refused", f"certificate={THIEF}.", "publish more than", key)


def test_a_storm_of_allowed_and_of_forbidden_messages(swarm: Attacked) -> None:
    key, forbidden = f"lab/{THIEF}/measurement/robots/{THIEF}", f"lab/{THIEF}/stop"
    message, stop = encode(measured(THIEF, THIEF, 1.0)), encode(StopRequest(id="storm", source="x"))
    with swarm.session(THIEF) as thief:
        for number in range(5000):
            thief.put(key, message, congestion_control=BLOCK)
            thief.put(f"{forbidden}/{number}" if number % 2 else forbidden, stop, congestion_control=BLOCK)
        assert list(thief.get(ACCESS_KEY, timeout=10.0))
    swarm.logged("core", "message dropped", key, "a second of one sender")
    swarm.logged("hub", "the hub refused", f"certificate={THIEF}.", "tried=publish", forbidden)
    assert swarm.log("hub").count("the hub refused") < 100
