"""The WebSocket of a program: states at a rate, and twists that end with the connection.

Nothing waits for a slow client: a state is made when it can be sent, so that the newest wins, and a client that takes
nothing is closed.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from fullswarm.operator.console.access import Bucket
from fullswarm.operator.console.api import records
from fullswarm.operator.console.api.access import MOST_STREAMS, Access, decoded
from fullswarm.operator.console.api.acts import Actor
from fullswarm.operator.console.api.problems import ProblemError
from fullswarm.operator.console.api.reads import Reader
from fullswarm.operator.console.frames import MAX_BYTES
from fullswarm.operator.console.tokens import Admitted

HELLO_S = 3.0
STALLED_S = 5.0
CLOSE_S = 0.5
CHECK_S = 0.5
RATE_HZ, BURST = 60.0, 120.0
BAD_TOKEN, NO_HELLO, TOO_LARGE, TOO_MANY, BUSY = 4401, 4408, 1009, 1008, 1013

Made = Callable[[Admitted], tuple[Reader, Actor]]


class Stream:
    """One connection, from its opening to its end."""

    def __init__(self, websocket: WebSocket, access: Access, made: Made, now_s: Callable[[], float]) -> None:
        self._websocket, self._access, self._made, self._now_s = websocket, access, made, now_s
        self._wanted = records.Subscribe()
        self._subscribed = asyncio.Event()
        self._sequence = -1  # of the newest twists

    async def serve(self) -> None:
        """Serve it; driving ends before anything else when it is closed."""
        await self._websocket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            admitted = await self._admitted()
            if admitted is None:
                return
            usage = self._access.usage(admitted)
            if usage.streams >= MOST_STREAMS:
                await self._close(BUSY, f"{MOST_STREAMS} streams of this token are open")
                return
            self._websocket.state.admission.leave()
            usage.streams += 1
            try:
                await self._run(admitted)
            finally:
                usage.streams -= 1

    async def _admitted(self) -> Admitted | None:
        """Return whose token it has: of the header, or else of the first frame."""
        try:
            if "authorization" in self._websocket.headers:
                return self._access.caller(self._websocket.headers)
            async with asyncio.timeout(HELLO_S):
                text = await self._received()
            hello: records.Hello = decoded(text, records.Hello)
            return self._access.admit(hello.token)
        except TimeoutError:
            await self._close(NO_HELLO, "no hello")
        except ProblemError as error:
            await self._close(BAD_TOKEN, error.problem.detail[:100])
        return None

    async def _run(self, admitted: Admitted) -> None:
        reader, actor = self._made(admitted)
        tasks = {
            asyncio.create_task(self._send_states(reader)),
            asyncio.create_task(self._listen(admitted, actor)),
            asyncio.create_task(self._stays(admitted)),
        }
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            # Before anything is awaited: a client that is gone must not drive on.
            actor.program.twists.release(owner=self)
            actor.wake()
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        ended = (WebSocketDisconnect, asyncio.CancelledError)
        for result in results:
            if isinstance(result, BaseException) and not isinstance(result, ended) and self._open():
                raise result

    # ---------------------------------------------------------------- out
    async def _send_states(self, reader: Reader) -> None:
        """Send the newest states of the robots that are subscribed, until the client takes nothing more."""
        sequence = 0
        await self._subscribed.wait()
        while True:
            wanted = self._wanted
            robots = reader.some_robots(frozenset(wanted.robots))
            connected = reader.gateway.view.snapshot().connected
            sequence += 1
            await self._send(records.States(sequence=sequence, connected=connected, robots=robots))
            self._subscribed.clear()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._subscribed.wait(), 1.0 / self._wanted.rate_hz)

    async def _send(self, frame: msgspec.Struct) -> None:
        """Send a frame; a client that does not take it in time is closed."""
        try:
            async with asyncio.timeout(STALLED_S):
                await self._websocket.send_text(msgspec.json.encode(frame).decode())
        except TimeoutError:
            await self._close(BUSY, "too slow")
            raise WebSocketDisconnect(BUSY) from None

    # ---------------------------------------------------------------- in
    async def _listen(self, admitted: Admitted, actor: Actor) -> None:
        """Carry out the client's frames until it is gone or exceeds a limit."""
        bucket = Bucket(RATE_HZ, BURST)
        while True:
            text = await self._received()
            if len(text) > MAX_BYTES:
                await self._close(TOO_LARGE, "a frame too large")
                return
            if not bucket.take(self._now_s()):
                await self._close(TOO_MANY, "too many frames")
                return
            answer = self._carry_out(text, admitted, actor)
            if answer is not None:
                await self._send(answer)

    def _carry_out(self, text: str | bytes, admitted: Admitted, actor: Actor) -> msgspec.Struct | None:
        """Carry out a frame; return its answer, if it has one."""
        sequence = None
        try:
            frame: records.FromClient = decoded(text, records.FromClient)
            if isinstance(frame, records.Subscribe):
                expanded = actor.reader.expanded(frame.robots)
                self._wanted = msgspec.structs.replace(frame, robots=expanded)
                self._subscribed.set()
                return None
            self._access.check_change(admitted)
            if isinstance(frame, records.Release):
                actor.program.twists.release(owner=self)
                actor.wake()
                return None
            sequence = frame.sequence
            return self._drive(frame, actor)
        except ProblemError as error:
            return _refused(error, sequence)

    def _drive(self, frame: records.Twists, actor: Actor) -> msgspec.Struct:
        if frame.sequence <= self._sequence:
            what = f"sequence {frame.sequence} is not newer than {self._sequence}"
            return records.Refused(status=409, detail=what, where="sequence", sequence=frame.sequence)
        self._sequence = frame.sequence
        failed: ProblemError | None = None
        for robot, (linear_m_s, angular_rad_s) in frame.twists.items():
            try:
                actor.drive(robot, linear_m_s, angular_rad_s, frame.ttl_s, self)
            except ProblemError as error:  # the other robots are driven
                failed = failed or error
        if failed is not None:
            return _refused(failed, frame.sequence)
        return records.Accepted(sequence=frame.sequence)

    async def _received(self) -> str | bytes:
        """Return the next frame as it came.

        Raises
        ------
        WebSocketDisconnect
            There is none: the client is gone.
        """
        message = await self._websocket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1005))
        text = message.get("text")
        data: str | bytes = message["bytes"] if text is None else text
        return data

    # ---------------------------------------------------------------- end
    async def _stays(self, admitted: Admitted) -> None:
        """Return when the token has ended."""
        while self._access.doorkeeper.holds(admitted):
            await asyncio.sleep(CHECK_S)
        await self._close(BAD_TOKEN, "token")

    def _open(self) -> bool:
        return self._websocket.application_state is WebSocketState.CONNECTED

    async def _close(self, code: int, reason: str) -> None:
        if self._open():
            # It may be closed by the client meanwhile, and one that takes nothing does not take the closing either.
            with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
                async with asyncio.timeout(CLOSE_S):
                    await self._websocket.close(code, reason)


def _refused(error: ProblemError, sequence: int | None) -> records.Refused:
    problem = error.problem
    return records.Refused(
        status=problem.status, detail=problem.detail, where=problem.where, hint=problem.hint, code=problem.code,
        sequence=sequence,
    )  # fmt: skip
