"""What a player shows, and the thread that runs it."""

from __future__ import annotations

import select
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fullswarm.clock import MonotonicClock

TURN_S = 0.02


@dataclass(frozen=True, slots=True)
class Shown:
    """A body that a player shows, in the axes and the unit of the system that it plays.

    Parameters
    ----------
    quaternion : x, y, z, w
    seen : the cameras see it
    """

    name: str
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    seen: bool = True


class Server(ABC):
    """Runs a system on a thread: `frame` shows the next frame, answers go out by themselves.

    Parameters
    ----------
    names : of all bodies that it will ever show, in their order
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self._clock = MonotonicClock()
        self._began_s = self._clock.now_s()
        self._lock = threading.Lock()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="mocap player", daemon=True)

    @property
    @abstractmethod
    def port(self) -> int:
        """The port at which it can be reached."""

    @abstractmethod
    def sockets(self) -> Sequence[socket.socket]:
        """Return what to wait on."""

    @abstractmethod
    def answer(self, ready: socket.socket) -> None:
        """Answer what has arrived on a socket; `OSError`: that client is gone."""

    @abstractmethod
    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Send a frame to all clients."""

    def drop(self, gone: socket.socket) -> None:
        """Forget a client that is gone."""
        del gone

    def start(self) -> None:
        """Serve from now on."""
        self._thread.start()

    def frame(self, bodies: Sequence[Shown]) -> None:
        """Show a frame, exposed now."""
        with self._lock:
            self.send(bodies, self._clock.now_s() - self._began_s)

    def _run(self) -> None:
        while not self._closing:
            ready, _, _ = select.select(self.sockets(), (), (), TURN_S)
            with self._lock:
                for each in ready:
                    try:
                        self.answer(each)
                    except OSError:
                        self.drop(each)

    def close(self) -> None:
        """End, without a farewell to the clients."""
        self._closing = True
        if self._thread.is_alive():
            self._thread.join()
        for each in self.sockets():
            each.close()


class StreamServer(Server):
    """A server whose clients connect over TCP."""

    def __init__(self, names: Sequence[str], host: str, port: int) -> None:
        super().__init__(names)
        self._listener = socket.create_server((host, port))
        self.clients: list[socket.socket] = []

    @property
    def port(self) -> int:
        """The TCP port."""
        number: int = self._listener.getsockname()[1]
        return number

    def sockets(self) -> Sequence[socket.socket]:
        """Return the listener and all clients."""
        return (self._listener, *self.clients)

    def answer(self, ready: socket.socket) -> None:
        """Take a new client, or what a client says."""
        if ready is self._listener:
            client, _ = self._listener.accept()
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client.settimeout(1.0)
            self.clients.append(client)
            self.greet(client)
            return
        data = ready.recv(65_536)
        if not data:
            raise ConnectionResetError
        self.hear(ready, data)

    @abstractmethod
    def greet(self, client: socket.socket) -> None:
        """Say what a server says first."""

    @abstractmethod
    def hear(self, client: socket.socket, data: bytes) -> None:
        """Take what a client says."""

    def drop(self, gone: socket.socket) -> None:
        """Forget a client that is gone."""
        gone.close()
        self.clients = [each for each in self.clients if each is not gone]

    def send_all(self, data: Callable[[socket.socket], bytes]) -> None:
        """Send each client its bytes."""
        for client in tuple(self.clients):
            try:
                client.sendall(data(client))
            except OSError:
                self.drop(client)
