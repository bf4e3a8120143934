"""A bus and a clock for the test of one node: messages pass the wire format and are kept, time passes on demand."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import TypeVar

from fullswarm.bus import LocalBus, Subscription
from fullswarm.bus.codec import decode, encode
from fullswarm.clock import SimClock as FakeClock
from fullswarm.errors import MessageError
from fullswarm.messages import Message
from fullswarm.runtime import Mailbox, Runtime

M = TypeVar("M", bound=Message)


class LoopbackBus:
    """A :class:`~fullswarm.bus.Bus` within one process that encodes and decodes every message.

    Parameters
    ----------
    mailbox
        Where messages wait; one of its own by default. Give it to the runtime that the nodes run on.
    loss
        Share of the messages that are lost, 0 to 1.
    seed
        Of the losses: the same seed loses the same messages.
    """

    def __init__(self, mailbox: Mailbox | None = None, *, loss: float = 0.0, seed: int = 0) -> None:
        if not 0.0 <= loss <= 1.0:
            raise ValueError(f"a loss is a share from 0 to 1, not {loss}")
        self.mailbox = mailbox or Mailbox()
        self._local = LocalBus(self.mailbox)
        self._loss, self._random = loss, random.Random(seed)  # noqa: S311  (must repeat, keeps no secret)
        self._sent: list[tuple[str, Message]] = []

    def publish(self, key: str, message: Message) -> None:
        """Deliver what would come off the wire.

        Raises
        ------
        AssertionError
            The message does not survive the wire, e.g. a NumPy number where a float belongs.
        """
        if not self._local.connected():
            return
        try:
            arrived = decode(encode(message), type(message))
        except (TypeError, ValueError, OverflowError, MessageError) as error:
            raise AssertionError(
                f"{type(message).__name__} on '{key}' does not survive the wire: {error}; "
                "fill its fields with plain Python values of the types that messages.py gives them"
            ) from error
        self._sent.append((key, arrived))
        if self._random.random() >= self._loss:
            self._local.publish(key, arrived)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Deliver messages of type `kind` on matching keys to `handler`, when the mailbox is drained."""
        return self._local.subscribe(expression, kind, handler, latest=latest)

    def drain(self) -> int:
        """Deliver all that waits, and what that causes; return how many."""
        return self.mailbox.drain()

    def sent(self, kind: type[M], key: str = "") -> list[M]:
        """Return the messages of type `kind` published so far, lost ones too; with `key` only those on it."""
        return [each for on, each in self._sent if isinstance(each, kind) and key in ("", on)]

    def connected(self) -> bool:
        """Return True until closed."""
        return self._local.connected()

    def close(self) -> None:
        """End all subscriptions. What was sent can still be looked at."""
        self._local.close()


__all__ = ["FakeClock", "simulated_runtime"]


def simulated_runtime(mailbox: Mailbox | None = None, *, start_s: float = 0.0) -> Runtime:
    """Return a runtime on a :class:`FakeClock`: ``run(10.0)`` takes no longer than what the nodes compute.

    Parameters
    ----------
    mailbox
        Of the bus that the nodes use; all of them share one.
    start_s
        What the clock shows first. A node must not care; tests find out with another value than 0.
    """
    return Runtime(FakeClock(start_s), mailbox)
