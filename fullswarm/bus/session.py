"""Zenoh's settings, one place for hub and clients, and the thread that keeps a client's session."""

from __future__ import annotations

import atexit
import json
import threading
from collections.abc import Callable

import zenoh

from fullswarm.errors import Unreachable

RETRY_FIRST_S, RETRY_LAST_S, RETRY_FACTOR = 0.1, 0.5, 2
CLOSE_S = 0.5
"""Longest wait for a session to end: with a frozen hub zenoh itself would take nine seconds."""

_COMMON: dict[str, object] = {
    # Nothing is found by accident: the default settings join any zenoh on the local network.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # else opening a router waits 0.5 s in vain
    "transport/link/tx/lease": 1000,  # ms; what a node announces: its silence is noticed after this
    # Our messages are small: shared memory saves nothing, costs 16 MB and leaves files after a kill.
    "transport/shared_memory/enabled": False,
}


def config(**settings: object) -> zenoh.Config:
    """Return a zenoh configuration: the common settings, then `settings` (``/`` of a name written ``__``)."""
    result = zenoh.Config()
    renamed = {name.replace("__", "/"): value for name, value in settings.items()}
    for name, value in (_COMMON | renamed).items():
        result.insert_json5(name, json.dumps(value))
    return result


def untyped(method: Callable[[], object]) -> None:
    """Call a method that zenoh's stubs leave without types."""
    method()


def reason_of(error: zenoh.ZError) -> str:
    """Return what zenoh says, without the place in its sources."""
    return str(error).split(" at /")[0]


def client_config(hub: str, *, multicast: bool) -> zenoh.Config:
    """Return the configuration of a client of the hub at the endpoint `hub`."""
    return config(
        mode="client",
        connect__endpoints=[hub],
        connect__retry={
            "period_init_ms": round(RETRY_FIRST_S * 1000),
            "period_max_ms": round(RETRY_LAST_S * 1000),
            "period_increase_factor": RETRY_FACTOR,
        },
        scouting__multicast__enabled=multicast,
    )


class HubLink:
    """Opens a client's session as soon as the hub is there, watches the link, closes it at the end.

    One daemon thread does all that may block. `up` tells whether the link stands; zenoh's transport events set
    it, so that reading it costs nothing. After a loss zenoh connects again by itself and restores what was
    declared.

    Parameters
    ----------
    hub
        Endpoint of the hub.
    multicast
        Also search for routers by multicast.
    on_open
        Called once, on the link's thread, with the open session and before `up` becomes true.
    """

    def __init__(self, hub: str, *, multicast: bool, on_open: Callable[[zenoh.Session], None]) -> None:
        self.hub, self.up = hub, False
        self._on_open = on_open
        self._config = client_config(hub, multicast=multicast)
        self._routers: set[str] = set()
        self._lock = threading.Lock()
        self._is_up, self._closing = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._serve, name="fullswarm-bus", daemon=True)
        # Without it a message that arrives while the interpreter shuts down finds no interpreter.
        atexit.register(self.close)
        self._thread.start()

    def _serve(self) -> None:
        session = self._open()
        if session is None:
            return
        try:
            if not self._closing.is_set():
                self._on_open(session)
                listener = zenoh.handlers.Callback(self._on_event, indirect=False)
                session.info.declare_transport_events_listener(listener, history=True)
            self._closing.wait()
        finally:
            untyped(session.close)

    def _open(self) -> zenoh.Session | None:
        delay_s = RETRY_FIRST_S
        while not self._closing.is_set():
            try:
                return zenoh.open(self._config)
            except zenoh.ZError:  # no hub listens there yet
                self._closing.wait(delay_s)
                delay_s = min(delay_s * RETRY_FACTOR, RETRY_LAST_S)
        return None

    def _on_event(self, event: zenoh.TransportEvent) -> None:
        """Book a transport that came or went; runs on zenoh's threads, at once."""
        zid = str(event.transport.zid)
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                self._routers.add(zid)
            else:
                self._routers.discard(zid)
            self.up = bool(self._routers) and not self._closing.is_set()
            if self.up:
                self._is_up.set()
            else:
                self._is_up.clear()

    def wait(self, timeout_s: float) -> None:
        """Return once the link stands.

        Raises
        ------
        Unreachable
            It does not within `timeout_s`, or the link is closed.
        """
        if self._closing.is_set():
            raise Unreachable("this bus is closed", where=self.hub)
        if not self._is_up.wait(timeout_s):
            raise Unreachable(
                "no hub answers",
                where=self.hub,
                hint="start a swarm with `fullswarm up FLEET.toml`, or say where its hub is with --hub",
            )

    def close(self) -> None:
        """End the session; return within `CLOSE_S` even when the hub is frozen. Closing twice is fine."""
        atexit.unregister(self.close)
        self._closing.set()
        with self._lock:
            self.up = False
            self._is_up.clear()
        self._thread.join(CLOSE_S)
