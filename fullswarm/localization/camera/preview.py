"""Serves a camera's live picture over HTTP: ``/`` a page, ``/stream.mjpg``, ``/picture.jpg``; no window is needed.

Pictures are drawn and compressed only while a client is connected.
"""

from __future__ import annotations

import contextlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from fullswarm.bus.endpoint import is_loopback
from fullswarm.errors import ConfigError

BOUNDARY = "picture"
MOST_VIEWERS = 8
WAIT_S = 2.0
SOCKET_S = 5.0
PAGE = b"""<!doctype html><meta charset="utf-8"><title>fullswarm track</title>
<style>body{margin:0;background:#111}img{display:block;width:100vw;height:100vh;object-fit:contain}</style>
<img src="/stream.mjpg" alt="live picture of the camera">"""


class Preview:
    """A server with one thread per viewer; the newest picture is handed to it by :meth:`show`.

    Attributes
    ----------
    address : ``http://host:port``

    Raises
    ------
    ConfigError
        The address is none, is taken, or not loopback.
    """

    def __init__(self, listen: str, insecure_network: bool = False) -> None:
        host, _, port = listen.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise ConfigError("expected HOST:PORT", where=f"--show {listen}", hint="like 127.0.0.1:8808")
        if not is_loopback(host) and not insecure_network:
            raise ConfigError(
                "this address is open to the network: everyone there could watch", where=f"--show {listen}",
                hint="use 127.0.0.1, or allow it with --insecure-network on a network that you trust",
            )  # fmt: skip
        self._newest: tuple[int, bytes] = 0, b""
        self._changed = threading.Condition()
        self._viewers = 0
        self._closed = False
        preview = self

        class Handler(_Handler):
            owner = preview

        try:
            self._server = ThreadingHTTPServer((host.strip("[]"), int(port)), Handler)
        except OSError as error:
            raise ConfigError(
                f"cannot listen there: {error.strerror or error}", where=f"--show {listen}", hint="choose another port"
            ) from error
        self._server.daemon_threads = True
        self.local = is_loopback(host)
        self.address = f"http://{host}:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="preview", daemon=True)
        self._thread.start()

    @property
    def watched(self) -> bool:
        """Whether a client is connected."""
        return self._viewers > 0

    def show(self, jpeg: bytes) -> None:
        """Show a picture to all viewers."""
        with self._changed:
            self._newest = self._newest[0] + 1, jpeg
            self._changed.notify_all()

    def after(self, number: int, wait_s: float = WAIT_S) -> tuple[int, bytes]:
        """Return a picture newer than number `number`; after `wait_s` the one there is."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest[0] > number or self._closed, wait_s)
            return self._newest

    @contextlib.contextmanager
    def viewer(self) -> Any:
        """Count a viewer; yields whether there is room for it."""
        with self._changed:
            room = self._viewers < MOST_VIEWERS
            self._viewers += 1
        try:
            yield room
        finally:
            with self._changed:
                self._viewers -= 1

    @property
    def closed(self) -> bool:
        """It serves no more."""
        return self._closed

    def close(self) -> None:
        """Stop serving."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    owner: Preview
    timeout = SOCKET_S
    protocol_version = "HTTP/1.0"

    def do_GET(self) -> None:
        """Serve one request."""
        # Another site could point its host name here and read the picture.
        host = self.headers.get("Host", "").rpartition(":")[0].strip("[]") or self.headers.get("Host", "")
        if self.owner.local and not is_loopback(host):
            self.send_error(403, "unknown host name")
        elif self.path == "/":
            self._whole("text/html; charset=utf-8", PAGE)
        elif self.path == "/picture.jpg":
            with self.owner.viewer():
                self._whole("image/jpeg", self.owner.after(self.owner.after(0, 0.0)[0])[1])
        elif self.path == "/stream.mjpg":
            with self.owner.viewer() as room:
                self._stream() if room else self.send_error(503, "too many viewers")
        else:
            self.send_error(404)

    def _whole(self, kind: str, content: bytes) -> None:
        if not content:
            self.send_error(503, "no picture yet")
            return
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number = 0
        with contextlib.suppress(OSError):  # the viewer is gone
            while not self.owner.closed:
                newest, content = self.owner.after(number)
                if newest == number:
                    continue
                number = newest
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
                self.wfile.write(head.encode() + content + b"\r\n")

    def log_message(self, *_: object) -> None:
        """Log nothing: each viewer would be a line."""
