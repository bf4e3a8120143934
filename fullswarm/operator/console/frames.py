"""Defines and checks the frames that a page may send. Nothing here raises on malformed input."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from fullswarm.messages import MissionPlan, Needs, Roles, TeamName, Value

MAX_BYTES = 64 * 1024
LONGEST_INT = 2**53
"""Larger integers are not exact in JavaScript."""

MOST_CHARTS = 6
MOST_SCANNED = 4
"""Robots whose range scans a page shows at a time."""

Ref = Annotated[int, Meta(ge=0, le=LONGEST_INT)]
Robot = Annotated[str, Meta(pattern=r"\A@?[A-Za-z0-9_-]{1,64}\Z")]
Name = Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_-]{1,64}\Z")]
Robots = Annotated[tuple[Robot, ...], Meta(max_length=1024)]
Parameters = Annotated[dict[Name, Value], Meta(max_length=64)]
Stick = Annotated[float, Meta(ge=-1.0, le=1.0)]


class Hello(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="t", tag="hello"):
    """The first frame. `session` is the page's own secret: it identifies the operator after a reload."""

    token: Annotated[str, Meta(max_length=512)]
    session: Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_-]{8,64}\Z")]
    name: Annotated[str, Meta(pattern=r"\A[\w .\-]{0,32}\Z")] = ""


class Frame(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="t", tag=str.lower):
    """Base of the other frames; the tag is the class's name."""

    ref: Ref


class Request(Frame, frozen=True, kw_only=True):
    """Ask for a behaviour; no robots: the whole swarm."""

    behaviour: Name
    robots: Robots = ()
    parameters: Parameters = {}
    team: TeamName = ""
    needs: Needs = Needs()
    roles: Roles = {}
    take: bool = False


class Stop(Frame, frozen=True, kw_only=True):
    """Stop robots."""

    robots: Robots = ()


class Estop(Frame, frozen=True, kw_only=True):
    """Engage the latched e-stop."""

    robots: Robots = ()
    reason: Annotated[str, Meta(max_length=200)] = ""


class Clear(Frame, frozen=True, kw_only=True):
    """Release the latched e-stop."""

    robots: Robots = ()


class Drive(Frame, frozen=True, kw_only=True):
    """The dead-man is held; repeated at least every 0.1 s."""

    behaviour: Name
    robots: Robots = ()
    sticks: Annotated[dict[Name, Stick], Meta(min_length=1, max_length=8)]
    fixed: Parameters = {}


class Release(Frame, frozen=True, kw_only=True):
    """The dead-man was released."""


class Lease(Frame, frozen=True, kw_only=True):
    """Hold or release robots."""

    robots: Robots = ()
    hold: bool
    take: bool = False


class Mission(Frame, frozen=True, kw_only=True):
    """Control a mission; `track` and `step` for confirm."""

    op: Literal["pause", "resume", "abort", "confirm"]
    mission: Annotated[str, Meta(min_length=1, max_length=64)]
    track: Annotated[str, Meta(max_length=64)] = ""
    step: Annotated[str, Meta(max_length=64)] = ""
    take: bool = False


class StartMission(Frame, frozen=True, kw_only=True):
    """Start a mission, which the core checks as it does one from a file."""

    plan: MissionPlan
    take: bool = False


class Input(Frame, frozen=True, kw_only=True):
    """What the operator did on the page itself, for the log of a study."""

    kind: Literal["select", "view", "tool", "panel"]
    robots: Robots = ()
    detail: Annotated[str, Meta(max_length=32)] = ""


class Study(Frame, frozen=True, kw_only=True):
    """Begin a trial, answer a probe, rate the workload: `ratings` by subscale, `pairs` with the chosen one first."""

    op: Literal["start", "answer", "tlx"]
    probe: Annotated[str, Meta(max_length=64)] = ""
    value: Annotated[str, Meta(max_length=300)] = ""
    ratings: Annotated[dict[Name, int], Meta(max_length=6)] = {}
    pairs: Annotated[tuple[tuple[Name, Name], ...], Meta(max_length=15)] = ()


class Watch(Frame, frozen=True, kw_only=True):
    """Begin or end to look at the cameras' pictures."""

    on: bool


class Scans(Frame, frozen=True, kw_only=True):
    """Show the range scans of these robots from now on; of none if there are none."""

    robots: Annotated[tuple[Name, ...], Meta(max_length=MOST_SCANNED)] = ()


class Look(Frame, frozen=True, kw_only=True):
    """Look at a moment of the past: `at`, in seconds of the frames' clock."""

    at: Annotated[float, Meta(ge=-1e12, le=1e12)]


class Mark(Frame, frozen=True, kw_only=True):
    """Name a moment of the past, or delete a bookmark by its id."""

    op: Literal["add", "delete"]
    at: Annotated[float, Meta(ge=-1e12, le=1e12)] = 0.0
    name: Annotated[str, Meta(max_length=80)] = ""
    id: Annotated[str, Meta(max_length=32)] = ""


class Clip(Frame, frozen=True, kw_only=True):
    """Have a part of the past made into a file."""

    begin: Annotated[float, Meta(ge=-1e12, le=1e12)]
    end: Annotated[float, Meta(ge=-1e12, le=1e12)]
    kind: Literal["mcap", "gif", "mp4"]


class Inspect(Frame, frozen=True, kw_only=True):
    """Show the details of a robot; of none if it is empty."""

    robot: Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_-]{0,64}\Z")] = ""


class Charted(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A chart: a field of robots (none: of all), or a quantity of the swarm, as ``work.total_m``."""

    of: Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_.-]{1,128}\Z")]
    robots: Annotated[tuple[Name, ...], Meta(max_length=1024)] = ()


class Charts(Frame, frozen=True, kw_only=True):
    """Show these charts, up to now and on, or up to a moment of the past in seconds of the frames' clock."""

    charts: Annotated[tuple[Charted, ...], Meta(max_length=MOST_CHARTS)] = ()
    at: Annotated[float, Meta(ge=-1e12, le=1e12)] | None = None


class Undo(Frame, frozen=True, kw_only=True):
    """Undo the newest request of this operator, if it is still the one with this id."""

    id: Annotated[str, Meta(min_length=1, max_length=64)]


class Group(Frame, frozen=True, kw_only=True):
    """Keep a group of robots for all consoles, or delete one."""

    op: Literal["save", "delete"]
    name: Name
    robots: Annotated[tuple[Name, ...], Meta(max_length=1024)] = ()


class Keep(Frame, frozen=True, kw_only=True):
    """Keep a place on the map or a request for all consoles under a name, or delete one; see :mod:`fullswarm.kept`."""

    op: Literal["save", "delete"]
    what: Literal["place", "saved"]
    name: Name
    value: dict[str, Any] | None = None


class HandOver(Frame, frozen=True, kw_only=True):
    """Offer robots to the operator `to`; withdraw, accept or decline the offer with an id."""

    op: Literal["offer", "withdraw", "accept", "decline"]
    to: Annotated[str, Meta(max_length=128)] = ""
    robots: Annotated[tuple[Name, ...], Meta(max_length=1024)] = ()
    id: Annotated[str, Meta(max_length=32)] = ""


class Experiment(Frame, frozen=True, kw_only=True):
    """Begin or end to look at the list of experiments, start one, stop the one that runs; no `seeds`: the file's."""

    op: Literal["watch", "unwatch", "start", "stop"]
    id: Annotated[str, Meta(max_length=300)] = ""
    small: bool = True
    seeds: Annotated[str, Meta(pattern=r"\A([0-9]{1,19}(-[0-9]{1,19})?)?\Z")] = ""


class Ping(Frame, frozen=True, kw_only=True):
    """Measure the round trip."""


Past = Look | Mark | Clip
Command = (
    Request | Stop | Estop | Clear | Drive | Release | Lease | Mission | StartMission | Input | Study | Watch | Past
    | Inspect | Charts | Scans | Undo | Group | Keep | HandOver | Experiment | Ping
)  # fmt: skip


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of a frame."""

    t: ClassVar[str] = "answer"
    ref: int | None
    ok: bool = True
    reason: str = ""
    request_id: str = ""

    def encoded(self) -> str:
        """Return it as it is sent."""
        return encode({"t": self.t, **msgspec.structs.asdict(self)})


class _Ref(msgspec.Struct, frozen=True):
    ref: Ref


_commands = msgspec.json.Decoder(Command)
_hello = msgspec.json.Decoder(Hello)
_ref = msgspec.json.Decoder(_Ref)
_encoder = msgspec.json.Encoder()
_WRONG = (msgspec.DecodeError, RecursionError, UnicodeDecodeError)


def encode(frame: object) -> str:
    """Return a frame as JSON text; numbers that are not finite become null."""
    return _encoder.encode(frame).decode()


def read_hello(text: str | bytes) -> Hello | None:
    """Return the first frame; None when it is not one."""
    try:
        return _hello.decode(text)
    except _WRONG:
        return None


def read_command(text: str | bytes) -> Command | Answer:
    """Return the command in a frame, or an answer with its error."""
    try:
        command: Command = _commands.decode(text)
    except _WRONG as error:
        return Answer(ref=_reference(text), ok=False, reason=f"malformed frame: {error}"[:300])
    match command:
        case Drive():
            given = list(command.fixed.items())
        case Request():
            given = list(command.parameters.items())
        case StartMission():
            steps = (step for track in command.plan.tracks for step in track.steps)
            given = [item for step in steps for item in step.parameters.items()]
        case _:
            given = []
    for name, value in given:
        if not fits(value):
            return Answer(ref=command.ref, ok=False, reason=f"{name} is too large a number or too long a text")
    return command


def _reference(text: str | bytes) -> int | None:
    try:
        return _ref.decode(text).ref
    except _WRONG:
        return None


def fits(value: object) -> bool:
    """Return whether a value of a parameter is short enough, and exact in JavaScript."""
    if isinstance(value, list):
        return all(map(fits, value))
    if isinstance(value, str):
        return len(value) <= 1024
    return not isinstance(value, int) or abs(value) <= LONGEST_INT
