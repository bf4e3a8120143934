"""Reads and writes a layer's local database over the bus (paper II.A)."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from typing import Literal

from fullswarm.bus.base import Bus, Subscription
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.keys import Keys
from fullswarm.messages import ParamChanged, ParamEntry, ParamReply, ParamRequest, Value
from fullswarm.operator import session
from fullswarm.operator.client import RESEND_S, short_id
from fullswarm.operator.session import Target
from fullswarm.runtime import Scheduler, Timer

Stored = Value | dict[str, object] | None
Operation = Literal["get", "set", "history"]
CORE = "core"
RESEND_LAST_S, JITTER = 1.0, 0.25


class ParamClient:
    """Reads, writes and watches the database of one layer."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        author: str,
        *,
        layer: str = "core",
        new_id: Callable[[], str] = short_id,
    ) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._author, self._layer, self._new_id = author, layer, new_id
        self._chance = random.Random(author)  # noqa: S311  (clients must not ask at the same moments)

    def ask(
        self,
        op: Operation,
        key: str,
        on_reply: Callable[[ParamReply], None],
        value: Stored = None,
        *,
        author: str = "",
    ) -> Callable[[], None]:
        """Send a question until it is answered, ever more seldom; `on_reply` is called once. Returns what withdraws it.

        `author` is noted with what it sets; empty: that of this client.

        The first repetitions come 0.2 s, 0.4 s and 0.8 s apart, the others a second, and a little later by chance: a
        database that is slow to answer must not be asked more and more.
        """
        question = ParamRequest(id=self._new_id(), op=op, key=key, value=value, author=author or self._author)

        timer: Timer | None = None

        def withdraw() -> None:
            nonlocal timer
            if timer is not None:
                timer.cancel()
                timer = None
                subscription.close()

        def receive(reply: ParamReply) -> None:
            if timer is not None and reply.id == question.id:
                withdraw()
                on_reply(reply)

        def send() -> None:
            nonlocal timer
            self._bus.publish(self._keys.param_request(self._layer), question)
            timer = self._scheduler.after(next(waits) * (1.0 + JITTER * self._chance.random()), send)

        subscription = self._bus.subscribe(self._keys.param_reply(self._layer, question.id), ParamReply, receive)
        waits = itertools.chain((RESEND_S, 2.0 * RESEND_S, 4.0 * RESEND_S), itertools.repeat(RESEND_LAST_S))
        send()
        return withdraw

    def watch(self, pattern: str, on_change: Callable[[ParamEntry], None]) -> Subscription:
        """Call `on_change` for every change of the key `pattern`, or of all that start with it up to its ``*``."""

        def receive(changed: ParamChanged) -> None:
            key = changed.entry.key
            if key == pattern or (pattern.endswith("*") and key.startswith(pattern[:-1])):
                on_change(changed.entry)

        return self._bus.subscribe(self._keys.param_changed(self._layer), ParamChanged, receive)


def ask(
    target: Target, layer: str, op: Operation, key: str, timeout_s: float, value: Stored = None
) -> tuple[ParamEntry, ...]:
    """Connect to a swarm, ask the database of one layer, and return the entries of its answer.

    Raises
    ------
    ConfigError
        The layer refuses, with its reason.
    Unreachable
        No hub or no such layer answers within `timeout_s`.
    """
    answer: ParamReply | None = None
    with session.connect(target) as connection:

        def receive(reply: ParamReply) -> None:
            nonlocal answer
            answer = reply
            connection.finish()

        client = ParamClient(connection.bus, connection.keys, connection.runtime, connection.source, layer=layer)
        client.ask(op, key, receive, value)
        connection.run(timeout_s)
        if answer is None:
            if layer == CORE:
                raise connection.no_core(timeout_s)
            hint = f"the one with a database is '{CORE}'"
            raise Unreachable(f"no layer '{layer}' answers", where=connection.hub, hint=hint)
    if not answer.ok:
        reason = answer.reason or "refused without a reason"
        raise ConfigError(reason, where="" if reason.startswith((key, f"'{key}'")) else key)
    return answer.entries
