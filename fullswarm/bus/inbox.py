"""A subscription of the live bus: from zenoh's threads into the node's mailbox."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import zenoh

from fullswarm.bus.base import Delivery
from fullswarm.bus.codec import decode
from fullswarm.bus.session import reason_of, untyped
from fullswarm.errors import ConfigError, MessageError
from fullswarm.messages import Message
from fullswarm.runtime import Mailbox

LONGEST_NAME = 128
"""Bytes of a sender's name; what is longer is not one."""


class Inbox:
    """One handler's interest in a key expression. Zenoh may call :meth:`receive` on several threads at once.

    Parameters
    ----------
    mailbox
        Where the messages wait for the node.
    expression, kind, handler
        What to listen to, the type to decode, what to call.
    latest
        Keep one message per key: a newer one takes the place of one that still waits.
    with_sender
        Give the handler a :class:`~fullswarm.bus.base.Delivery` in place of the message.
    urgent
        Run the handler on zenoh's thread when the node is idle (see :meth:`Mailbox.run_now`).
    on_bad
        Told the key and the error of a message that is dropped.
    on_close
        Told once, by :meth:`close`.

    Raises
    ------
    ConfigError
        `expression` is not a key expression.
    """

    def __init__(
        self,
        mailbox: Mailbox,
        expression: str,
        kind: type[Message],
        handler: Callable[[Any], None],
        *,
        latest: bool,
        with_sender: bool,
        urgent: bool,
        on_bad: Callable[[str, MessageError], None],
        on_close: Callable[[Inbox], None],
    ) -> None:
        try:
            zenoh.KeyExpr(expression)
        except zenoh.ZError as error:
            raise ConfigError(f"'{expression}' is not a key expression", hint=reason_of(error)) from error
        self.expression, self.kind = expression, kind
        self._mailbox, self._handler, self._latest = mailbox, handler, latest
        self._on_bad, self._on_close = on_bad, on_close
        self._urgent, self._with_sender = urgent, with_sender
        self._waiting: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._declared: zenoh.Subscriber[None] | None = None
        self._active = True

    def declare(self, session: zenoh.Session) -> None:
        """Ask the hub for messages of other processes. The caller sees to it that this happens once."""
        if self._active:
            # Direct: zenoh's own handler thread is not a daemon, a process with one would never end.
            callback = zenoh.handlers.Callback(self.receive, indirect=False)
            self._declared = session.declare_subscriber(self.expression, callback, allowed_origin=zenoh.Locality.REMOTE)

    def receive(self, sample: zenoh.Sample) -> None:
        """Take a message from another process."""
        try:
            message = decode(sample.payload.to_bytes(), self.kind)
        except MessageError as error:
            self._on_bad(str(sample.key_expr), error)
            return
        item = Delivery(message, _sender(sample)) if self._with_sender else message
        if self._urgent and self._mailbox.run_now(self._deliver, item):
            return
        if self._latest:
            self._replace(str(sample.key_expr), item)
        else:
            self._mailbox.put(self._deliver, item)

    def offer(self, key: str, message: Message, sender: str) -> None:
        """Take a message of the same process, as it is."""
        if not isinstance(message, self.kind):
            error = MessageError(f"got {type(message).__name__}", where=self.kind.__name__)
            self._on_bad(key, error)
            return
        item = Delivery(message, sender) if self._with_sender else message
        if self._latest:
            self._replace(key, item)
        else:
            self._mailbox.put(self._deliver, item)

    def _replace(self, key: str, item: Any) -> None:
        with self._lock:
            is_new = key not in self._waiting
            self._waiting[key] = item
        if is_new:
            self._mailbox.put(self._deliver_key, key)

    def _deliver(self, item: Any) -> None:
        if self._active:
            self._handler(item)

    def _deliver_key(self, key: str) -> None:
        with self._lock:
            item = self._waiting.pop(key)
        if self._active:
            self._handler(item)

    def close(self) -> None:
        """Stop delivering; closing twice is fine."""
        if not self._active:
            return
        self._active = False
        self._on_close(self)

    def undeclare(self) -> None:
        """Tell the hub."""
        declared, self._declared = self._declared, None
        if declared is not None:
            untyped(declared.undeclare)


def _sender(sample: zenoh.Sample) -> str:
    """Return the sender's name that travels as the attachment; empty where there is none, or it is not a name."""
    attached = sample.attachment
    if attached is None:
        return ""
    data = attached.to_bytes()
    return data.decode("ascii", "replace") if len(data) <= LONGEST_NAME else ""
