"""A pilot on a simulated clock: a pad that tests press, a stand-in for the core, and what the pilot sent."""

from __future__ import annotations

import itertools

from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    EStop,
    HealthReport,
    Heartbeat,
    Interventions,
    Lease,
    LeaseRequest,
    Leases,
    ParamEntry,
    ParamReply,
    ParamRequest,
    RequestStatus,
    RobotHealth,
    StopRequest,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.joystick.bindings import Bindings, load_bindings
from fullswarm.operator.joystick.pilot import Pilot
from fullswarm.operator.joystick.state import AXES, PadState
from fullswarm.runtime import Runtime

ME = "anna@lab"
LB, RB = "leftshoulder", "rightshoulder"
ALWAYS = load_bindings()
STREAMED = ("move_left_bc", "move_right_bc", "move_forward_bc", "move_backward_bc", "drive_bc")


class FakePads:
    """Pads that tests plug in, press and push."""

    def __init__(self) -> None:
        self.pads: dict[int, PadState] = {}
        self.rumbles: list[int] = []
        self.error: Exception | None = None
        self._ids = itertools.count(1)

    def plug(self, *buttons: str, known: bool = True) -> int:
        number = next(self._ids)
        axes = dict.fromkeys(AXES, 0.0) if known else {}
        self.pads[number] = PadState(number, f"pad {number}", f"{number:032x}", known, axes, frozenset(buttons))
        return number

    def set(self, number: int, buttons: frozenset[str] | None = None, **axes: float) -> None:
        pad = self.pads[number]
        pressed = pad.buttons if buttons is None else buttons
        self.pads[number] = PadState(pad.id, pad.name, pad.guid, pad.known, {**pad.axes, **axes}, pressed)

    def poll(self) -> tuple[PadState, ...]:
        if self.error is not None:
            raise self.error
        return tuple(self.pads.values())

    def rumble(self, pad: int, strength: float, seconds: float) -> None:
        assert 0.0 < strength <= 1.0
        assert seconds > 0.0
        self.rumbles.append(pad)


class LabBus(LocalBus):
    """A bus whose hub can be lost."""

    hub = True

    def connected(self) -> bool:
        return self.hub and super().connected()


class Bench:
    """Four robots of two makes, a core that answers, one pad."""

    def __init__(self, *, bindings: Bindings = ALWAYS, pad: str = "", only: tuple[str, ...] = ()) -> None:
        self.runtime = Runtime(SimClock(100.0))
        self.bus = LabBus(self.runtime.mailbox)
        self.keys = Keys("lab")
        self.core = True
        self._sequence = 0
        self.holders: dict[str, str] = {}
        self.grant = True
        self.refuse = ""
        self.groups: dict[str, list[str]] = {"scouts": ["r1", "r3"]}
        self.robots = {"r1": "Create", "r2": "Create", "r3": "Rover", "r4": "Rover"}
        self.requests: list[tuple[float, BehaviourRequest]] = []
        self.stops: list[tuple[float, StopRequest]] = []
        self.estops: list[EStop] = []
        self.lease_requests: list[LeaseRequest] = []
        ids = itertools.count(1)
        operator = Operator(self.bus, self.keys, self.runtime, "t", name=ME, new_id=lambda: f"id{next(ids)}")
        self.pads = FakePads()
        self.pilot = Pilot(self.bus, self.keys, self.runtime, operator, self.pads, bindings, pad=pad, only=only)
        self.bus.subscribe(self.keys.behaviour_request, BehaviourRequest, self._on_request)
        self.bus.subscribe(self.keys.stop, StopRequest, lambda each: self.stops.append((self.time_s, each)))
        self.bus.subscribe(self.keys.estop, EStop, self.estops.append)
        self.bus.subscribe(self.keys.lease_request, LeaseRequest, self._on_lease)
        self.bus.subscribe(self.keys.param_request("core"), ParamRequest, self._on_param)
        self.runtime.every(0.1, self._beat, first_s=0.0)
        self.runtime.every(0.5, self._report, first_s=0.0)
        self.runtime.every(1.0, self.tell_leases, first_s=0.0)
        self.pilot.start()
        self.pad = self.pads.plug()
        self.run(1.0)

    @property
    def time_s(self) -> float:
        return self.runtime.now_s()

    # ------------------------------------------------------------------ the user's hands
    def press(self, *buttons: str, pad: int = 0) -> None:
        number = pad or self.pad
        self.pads.set(number, buttons=self.pads.pads[number].buttons | set(buttons))
        self.run(0.01)

    def release(self, *buttons: str, pad: int = 0) -> None:
        number = pad or self.pad
        self.pads.set(number, buttons=self.pads.pads[number].buttons - set(buttons))
        self.run(0.01)

    def tap(self, *buttons: str, pad: int = 0) -> None:
        self.press(*buttons, pad=pad)
        self.release(*buttons, pad=pad)

    def push(self, **axes: float) -> None:
        self.pads.set(self.pad, None, **axes)
        self.run(0.03)

    def unplug(self) -> None:
        del self.pads.pads[self.pad]

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    # ------------------------------------------------------------------ what came of it
    def newest(self) -> BehaviourRequest:
        return self.requests[-1][1]

    def sent_since(self, time_s: float) -> list[BehaviourRequest]:
        return [request for at_s, request in self.requests if at_s >= time_s]

    def note(self) -> str:
        return self.pilot.status().note

    # ------------------------------------------------------------------ the swarm
    def intervene(self, robot: str) -> None:
        message = Interventions(host="h", robots=(robot,), x_m_s=(0.1,), y_m_s=(0.0,), reasons=("keeps clear of r9",))
        self.bus.publish(self.keys.intervention("h"), message)

    def tell_leases(self) -> None:
        if self.core:
            leases = tuple(Lease(robot=robot, operator=who, age_s=1.0) for robot, who in self.holders.items())
            self._sequence += 1
            self.bus.publish(self.keys.leases, Leases(leases=leases, core="c", sequence=self._sequence))

    def _on_lease(self, request: LeaseRequest) -> None:
        self.lease_requests.append(request)
        for robot in request.robots if self.core and self.grant else ():
            if request.hold and (request.take or self.holders.get(robot, request.operator) == request.operator):
                self.holders[robot] = request.operator
            elif not request.hold and self.holders.get(robot) == request.operator:
                del self.holders[robot]
        self.tell_leases()

    def _on_request(self, request: BehaviourRequest) -> None:
        self.requests.append((self.time_s, request))
        if self.core:
            status = RequestStatus(
                request_id=request.id,
                behaviour=request.behaviour,
                phase="refused" if self.refuse else "accepted",
                reason=self.refuse,
            )
            self.bus.publish(self.keys.behaviour_status, status)

    def _on_param(self, request: ParamRequest) -> None:
        entries = tuple(
            ParamEntry(key=f"group/{name}", value={"robots": list(robots)}, author="", changed=0.0)
            for name, robots in self.groups.items()
        )
        self.bus.publish(self.keys.param_reply("core", request.id), ParamReply(id=request.id, ok=True, entries=entries))

    def _beat(self) -> None:
        if self.core:
            self.bus.publish(self.keys.heartbeat("core"), Heartbeat(node="core", process="c", sequence=1))

    def _report(self) -> None:
        robots = tuple(
            RobotHealth(robot=robot, driver="null://x", make=make, model="", firmware="", lifecycle="ACTIVE")
            for robot, make in self.robots.items()
        )
        self.bus.publish(self.keys.health("h"), HealthReport(host="h", process="h-0", version="0", robots=robots))


def fresh() -> Bench:
    """Give a test a bench of its own: ``bench = pytest.fixture(fresh)``."""
    return Bench()


def sticks(request: BehaviourRequest) -> list[float]:
    """Return how far a request pushes, axis by axis."""
    names = ("magnitude", "linear", "angular")
    return [float(str(request.parameters[name])) for name in names if name in request.parameters]
