"""Records a lockstep run: the same file as that of a live one, with times that begin when it was made."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from fullswarm.bus.base import Carried, matches
from fullswarm.bus.codec import encode
from fullswarm.bus.local import LocalBus
from fullswarm.clock import wall_time_s
from fullswarm.journal.journal import Journal, compressed
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import Message
from fullswarm.record.recorder import Recorder
from fullswarm.record.recording import Attachment, Recording
from fullswarm.record.session import about


class LockstepRecorder:
    """Gives a swarm in lockstep its journals, and records it from its first message on.

    Parameters
    ----------
    path : a new file
    fleet : the fleet file, if there is one
    on_failure : called once when nothing can be written any more, with the reason

    Raises
    ------
    ConfigError
        The file is there already, or cannot be written.
    """

    def __init__(
        self, path: Path, swarm: str, fleet: Path | None = None, on_failure: Callable[[str], None] = lambda _: None
    ) -> None:
        attachments = [] if fleet is None else [Attachment("fleet.toml", "application/toml", fleet.read_bytes())]
        self._recording = Recording(path, about(swarm), attachments)
        self._journals: dict[str, Journal] = {}
        self._recorder: Recorder | None = None
        self._on_failure = on_failure

    def begin(self, process: str, head: dict[str, object]) -> Journal:
        """Begin the journal of a process; see :class:`fullswarm.launch.journals.Begin`."""
        journal = self._journals[process] = Journal(head)
        return journal

    def record(self, lockstep: Lockstep) -> None:
        """Record a swarm that was built with `begin`."""
        bus = _TapBus(lockstep.bus, lockstep.runtime.now_s)
        start_ns = round(1e9 * wall_time_s())
        self._recorder = Recorder(
            bus, lockstep.keys, lockstep.runtime, self._recording, start_ns, None, self._on_failure, self._blocks
        )

    @property
    def messages(self) -> int:
        """Messages that were recorded."""
        return self._recording.messages

    def close(self) -> None:
        """Write the rest, after the swarm has been closed. Closing twice is fine."""
        if self._recorder is not None:
            self._recorder.close()
        self._recording.close()

    def _blocks(self) -> list[tuple[str, bytes]]:
        blocks = [(process, journal.take()) for process, journal in self._journals.items()]
        return [(process, compressed(block)) for process, block in blocks if block]


class _TapBus:
    """The bus of a process, whose messages can be had as they would be on the wire."""

    def __init__(self, bus: LocalBus, now_s: Callable[[], float]) -> None:
        self._bus, self._now_s = bus, now_s

    def tap(self, expressions: Sequence[str]) -> _LocalTap:
        """Collect all messages on matching keys."""
        tap = _LocalTap(tuple(expressions), self._now_s)
        self._bus.show(tap.note)
        return tap


class _LocalTap:
    def __init__(self, expressions: tuple[str, ...], now_s: Callable[[], float]) -> None:
        self._expressions, self._now_s, self._open = expressions, now_s, True
        self._found: deque[Carried] = deque()
        self.dropped = 0

    def note(self, key: str, message: Message, sender: str) -> None:
        if not self._open:
            return
        for number, expression in enumerate(self._expressions):
            if matches(expression, key):
                self._found.append(Carried(number, self._now_s(), key, sender, encode(message)))

    def take(self) -> list[Carried]:
        found = list(self._found)
        self._found.clear()
        return found

    def close(self) -> None:
        self._open = False
