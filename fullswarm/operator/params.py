"""Reads and writes a layer's local database over the bus (paper II.A)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from fullswarm.bus.base import Bus, Subscription
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.keys import Keys
from fullswarm.messages import ParamChanged, ParamEntry, ParamReply, ParamRequest, Value
from fullswarm.operator import session
from fullswarm.operator.client import RESEND_S, short_id
from fullswarm.operator.session import Target
from fullswarm.runtime import Scheduler

Stored = Value | dict[str, object] | None
Operation = Literal["get", "set", "history"]
CORE = "core"


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

    def ask(
        self,
        op: Operation,
        key: str,
        on_reply: Callable[[ParamReply], None],
        value: Stored = None,
    ) -> None:
        """Send a question every 0.2 s until it is answered; `on_reply` is called once."""
        question = ParamRequest(id=self._new_id(), op=op, key=key, value=value, author=self._author)

        def receive(reply: ParamReply) -> None:
            if timer.active and reply.id == question.id:
                timer.cancel()
                subscription.close()
                on_reply(reply)

        def send() -> None:
            self._bus.publish(self._keys.param_request(self._layer), question)

        subscription = self._bus.subscribe(self._keys.param_reply(self._layer, question.id), ParamReply, receive)
        timer = self._scheduler.every(RESEND_S, send)
        send()

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
