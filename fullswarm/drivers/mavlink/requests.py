"""Questions asked again until answered: commands one after the other, parameters written and read back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StationEncoder

RESEND_S = 0.5
TRIES = 4  # the first and three repeats
PARAMETER_S = 1.0
PARAMETER_TRIES = 3

MakeFrame = Callable[[int], bytes]
"""Makes a command's frame from its confirmation counter."""


@dataclass(slots=True)
class _Question:
    command: int
    make: MakeFrame
    done: Callable[[int | None], None]
    sent: int = 0
    due_s: float = 0.0


class CommandQueue:
    """Idempotent commands, one in flight: an ACK names the command but not its parameters."""

    def __init__(self) -> None:
        self._waiting: deque[_Question] = deque()

    @property
    def idle(self) -> bool:
        """Whether everything has been answered or given up."""
        return not self._waiting

    def ask(self, command: int, make: MakeFrame, done: Callable[[int | None], None]) -> None:
        """Send a command in its turn; `done` gets the result, or None when no answer came."""
        self._waiting.append(_Question(command, make, done))

    def clear(self) -> None:
        """Forget all questions without calling their handlers."""
        self._waiting.clear()

    def on_ack(self, ack: p.Ack) -> None:
        """Take an answer; one to a question not asked is ignored."""
        if not self._waiting or ack.result == p.Result.IN_PROGRESS:
            return
        first = self._waiting[0]
        if first.sent and first.command == ack.command:
            self._waiting.popleft()
            first.done(ack.result)

    def tick(self, now_s: float) -> list[bytes]:
        """Return the frame that is due, if any."""
        while self._waiting:
            first = self._waiting[0]
            if first.sent and now_s < first.due_s:
                return []
            if first.sent < TRIES:
                frame = first.make(first.sent)
                first.sent, first.due_s = first.sent + 1, now_s + RESEND_S
                return [frame]
            self._waiting.popleft()
            first.done(None)
        return []


class Pursuit:
    """One command repeated until the vehicle refuses it; its owner looks at the vehicle's state for success."""

    def __init__(self, command: int, make: MakeFrame, *, repeat_accepted: bool = True) -> None:
        self._command, self._make, self._repeat_accepted = command, make, repeat_accepted
        self.sent = 0
        self._due_s = 0.0
        self.result: int | None = None

    def on_ack(self, ack: p.Ack) -> None:
        """Take an answer to this command."""
        if self.sent and ack.command == self._command and ack.result != p.Result.IN_PROGRESS:
            self.result = ack.result

    @property
    def refused(self) -> bool:
        """Whether the vehicle refused."""
        return self.result not in (None, p.Result.ACCEPTED)

    def tick(self, now_s: float) -> list[bytes]:
        """Return the command's frame when it is due."""
        if self.result == p.Result.ACCEPTED and not self._repeat_accepted:
            return []
        if self.sent and now_s < self._due_s:
            return []
        frame = self._make(self.sent)
        self.sent, self._due_s = self.sent + 1, now_s + RESEND_S
        return [frame]


class ReadParameter:
    """Reads a parameter that may not exist: silence after three tries means it does not."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.value: float | None = None
        self.tries = 0
        self._given_up = False
        self._due_s = 0.0

    def receive(self, parameter: p.Parameter) -> None:
        """Take any parameter's value."""
        if parameter.name == self.name:
            self.value = parameter.value

    @property
    def settled(self) -> bool:
        """Whether it was answered, or given up."""
        return self.value is not None or self._given_up

    def tick(self, now_s: float, encoder: StationEncoder) -> list[bytes]:
        """Return the question when it is due."""
        if self.settled or now_s < self._due_s:
            return []
        if self.tries >= PARAMETER_TRIES:
            self._given_up = True
            return []
        self.tries, self._due_s = self.tries + 1, now_s + PARAMETER_S
        return [encoder.read_parameter(self.name)]


class EnsureParameter:
    """Reads a parameter, sets it if need be, and is content only with a value read back afterwards.

    With `writes` off it only reads, again and again, until a person has set it.
    """

    def __init__(
        self,
        name: str,
        wanted: float,
        accepted: frozenset[float],
        kind: int,
        *,
        bytewise: bool = False,
        writes: bool = True,
    ) -> None:
        self.name, self._wanted, self._accepted, self._kind = name, wanted, accepted, kind
        self._bytewise, self._writes = bytewise, writes
        self.found: float | None = None
        self.confirmed = False
        self.silent_tries = 0
        self._writing = False
        self._due_s = 0.0

    def receive(self, parameter: p.Parameter) -> None:
        """Take any parameter's value."""
        if parameter.name != self.name:
            return
        self.silent_tries, self.found = 0, parameter.value
        if not self._writes:
            self.confirmed = parameter.value in self._accepted
            return
        self._due_s = 0.0
        if self._writing:
            self._writing = False  # this may be the echo of our own write: ask what the vehicle holds
        elif parameter.value in self._accepted:
            self.confirmed = True
        else:
            self.confirmed, self._writing = False, True

    def tick(self, now_s: float, encoder: StationEncoder) -> list[bytes]:
        """Return the question or the setting when it is due."""
        if self.confirmed or now_s < self._due_s:
            return []
        self.silent_tries, self._due_s = self.silent_tries + 1, now_s + PARAMETER_S
        if self._writing:
            return [encoder.set_parameter(self.name, self._wanted, self._kind, bytewise=self._bytewise)]
        return [encoder.read_parameter(self.name)]
