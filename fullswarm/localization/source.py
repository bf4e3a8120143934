"""The contract of a source of poses, and the node that turns what it delivers into fixes.

A source has a link on a thread of its own, which delivers frames, bytes and troubles; the node reads them on the
runtime's thread.
"""

from __future__ import annotations

import base64
import json
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Protocol, TypeVar

from fullswarm.errors import ConfigError, without_login
from fullswarm.localization.publisher import FixPublisher, Names
from fullswarm.localization.sighting import Body, Convention, Frame, Ranging, Refused, Sighting
from fullswarm.runtime import Mailbox, Scheduler

WAITING = 1024
"""Arrivals that wait to be read; when there are more, the oldest are of no use any more."""
SILENT_S = 2.0
"""A source from which nothing has arrived for so long is reported."""
CHECK_S = 0.25
MAX_PROBLEM = 300


@dataclass(frozen=True, slots=True)
class Trouble:
    """Why a source gives no pose now, for people; empty: the trouble is over."""

    text: str


@dataclass(frozen=True, slots=True)
class Limited:
    """Why the poses of a source are worse than they could be, for people; empty: that is over."""

    text: str


Content = Frame | bytes | Refused
Seen = Sighting | Ranging | Refused | Trouble | Limited
Arrival = tuple[float, str, Content]
"""Arrival on this machine's clock, the sender's address, content."""


class Receiver(Protocol):
    """What a link delivers to; both may be called from any thread."""

    def arrive(self, arrival_s: float, sender: str, content: Content) -> None:
        """Take what has arrived."""
        ...

    def report(self, trouble: str) -> None:
        """Take why the connection is down; empty: it is up."""
        ...


class Source(Protocol):
    """A system that measures where robots are.

    Attributes
    ----------
    sensor : what it is, for operators: "mocap natnet"
    address : its URL, or the port at which it listens, for messages
    hint : what to look at when nothing arrives
    """

    sensor: str
    hint: str

    @property
    def address(self) -> str:
        """Where it is, for messages."""
        ...

    def start(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on."""
        ...

    def read(self, content: bytes) -> Iterable[Seen]:
        """Parse bytes that its link has delivered; called on the runtime's thread. Frames need no parser."""
        ...

    def close(self) -> None:
        """Stop delivering."""
        ...


class Recorder:
    """Writes what a source delivers to a file: JSON lines, the first one with the source and its conventions.

    Raises
    ------
    ConfigError
        The file exists already, or cannot be written.
    """

    def __init__(self, path: Path, url: str, convention: Convention) -> None:
        try:
            self._file: IO[str] = path.open("x")
        except FileExistsError:
            raise ConfigError("the file exists", where=str(path), hint="give the recording another name") from None
        except OSError as error:
            raise ConfigError(f"cannot write: {error.strerror}", where=str(path)) from error
        self._began_s: float | None = None
        self.frames = 0
        axes = "y-up" if convention.y_up else "z-up"
        self._line({"fullswarm_fixes": 1, "source": without_login(url), "axes": axes, "unit_m": convention.unit_m})

    def write(self, arrival_s: float, content: Content) -> None:
        """Write one arrival."""
        if isinstance(content, Refused):
            return
        if self._began_s is None:
            self._began_s = arrival_s
        line: dict[str, object] = {"t": round(arrival_s - self._began_s, 6)}
        if isinstance(content, bytes):
            line["data"] = base64.b64encode(content).decode()
        else:
            line["time_s"] = content.time_s
            line["bodies"] = [_as_json(body) for body in content.bodies]
        self._line(line)
        self.frames += 1

    def _line(self, content: dict[str, object]) -> None:
        self._file.write(json.dumps(content) + "\n")

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


def _as_json(body: Body) -> dict[str, object]:
    if not body.tracked:
        return {"name": body.name, "tracked": False}
    quaternion = None if body.quaternion is None else list(body.quaternion)
    return {"name": body.name, "position": [body.x, body.y, body.z], "quaternion": quaternion, "error": body.error}


@dataclass(frozen=True, slots=True)
class Anchors:
    """Where the anchors of a radio positioning system are.

    Parameters
    ----------
    places_m : x, y, z by the anchor's name, world frame
    radio_height_m : height of the robots' radios above the ground
    sigma_m : standard deviation of a distance that comes without one
    """

    places_m: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    radio_height_m: float = 0.0
    sigma_m: float = 0.1


T = TypeVar("T")


class SourceNode:
    """Turns what a source delivers into fixes, records it where wanted, and reports a source that is silent."""

    def __init__(
        self,
        source: Source,
        convention: Convention,
        publisher: FixPublisher | None,
        scheduler: Scheduler,
        mailbox: Mailbox,
        *,
        anchors: Anchors | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self._source, self._convention, self._publisher = source, convention, publisher
        self._anchors, self._recorder = anchors or Anchors(), recorder
        self._scheduler, self._mailbox = scheduler, mailbox
        self._waiting: deque[Arrival] = deque(maxlen=WAITING)
        self._link_trouble = self._own_trouble = self._limit = ""
        self._last_s = scheduler.now_s()
        self._timer = scheduler.every(CHECK_S, self._check)

    # ------------------------------------------------------------------ from the link's thread
    def arrive(self, arrival_s: float, sender: str, content: Content) -> None:
        """Take what has arrived; any thread may call it."""
        self._waiting.append((arrival_s, sender, content))
        self._mailbox.put(self._read, None)

    def report(self, trouble: str) -> None:
        """Take the state of the connection; any thread may call it."""
        self._mailbox.put(self._on_trouble, trouble)

    # ------------------------------------------------------------------ on the runtime's thread
    def _read(self, _: object = None) -> None:
        while self._waiting:
            arrival_s, sender, content = self._waiting.popleft()
            self._last_s = arrival_s
            if self._recorder is not None:
                self._recorder.write(arrival_s, content)
            for each in self._seen(content):
                self._take(each, arrival_s, sender)

    def _seen(self, content: Content) -> Iterable[Seen]:
        if isinstance(content, Refused):
            return (content,)
        if isinstance(content, bytes):
            return self._source.read(content)
        return [self._sighting(body, content.time_s) for body in content.bodies]

    def _sighting(self, body: Body, time_s: float | None) -> Sighting | Refused:
        try:
            return self._convention.sighting(body, time_s)
        except Refused as refused:
            return refused

    def _take(self, seen: Seen, arrival_s: float, sender: str) -> None:
        if isinstance(seen, Trouble):
            self._own_trouble = seen.text[:MAX_PROBLEM]
            self._check()
        elif isinstance(seen, Limited):
            self._limit = seen.text[:MAX_PROBLEM]
            self._check()
        elif self._publisher is None:
            return
        elif isinstance(seen, Refused):
            self._publisher.refuse(seen, sender)
        elif isinstance(seen, Sighting):
            self._own_trouble = ""
            self._publisher.publish(seen, arrival_s, sender)
        else:
            self._take_range(self._publisher, seen, arrival_s, sender)

    def _take_range(self, publisher: FixPublisher, seen: Ranging, arrival_s: float, sender: str) -> None:
        place_m = self._anchors.places_m.get(seen.anchor)
        if place_m is None:
            hint = f"'{seen.anchor:.40}': add its place to [anchors] in the fleet file"
            publisher.refuse(Refused("an anchor whose place is not known", hint), sender)
            return
        x_m, y_m, z_m = place_m
        above_m = (x_m, y_m, z_m - self._anchors.radio_height_m)
        publisher.publish_range(seen, above_m, seen.sigma_m or self._anchors.sigma_m, arrival_s, sender)

    def _on_trouble(self, trouble: str) -> None:
        self._link_trouble = trouble[:MAX_PROBLEM]
        self._check()

    def _check(self) -> None:
        if self._publisher is not None:
            self._publisher.problem(self.problem)

    @property
    def problem(self) -> str:
        """Why the source gives no pose now, or worse ones than it could; empty: it gives poses."""
        if self._link_trouble:
            return self._link_trouble
        if self._scheduler.now_s() - self._last_s > SILENT_S:
            return f"nothing arrives from {self._source.address}: {self._source.hint}"
        return "; ".join(each for each in (self._own_trouble, self._limit) if each)

    def start(self) -> None:
        """Have the source deliver."""
        self._source.start(self)

    def close(self) -> None:
        """Stop the source, then log the result."""
        self._timer.cancel()
        self._source.close()
        if self._publisher is not None:
            self._publisher.close()
        if self._recorder is not None:
            self._recorder.close()


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a source, from options or a fleet file.

    Parameters
    ----------
    url : ``natnet://192.168.1.5`` and the like; see :mod:`fullswarm.localization.schemes`
    axes, unit : None: what the system has by default; `ConfigError` if it has none
    robot : the robot on whose board the sensor is; empty: the source names robots itself
    origin_deg : latitude and longitude of the swarm's (0, 0)
    """

    url: str
    names: Names = field(default_factory=Names)
    axes: str | None = None
    unit: str | None = None
    sigma_m: float | None = None
    sigma_rad: float | None = None
    insecure_network: bool = False
    robot: str = ""
    origin_deg: tuple[float, float] | None = None
    anchors: Anchors = field(default_factory=Anchors)
