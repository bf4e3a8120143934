"""The application below ``/api/v1``: one endpoint per operation of the table, the document, its page and the stream."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import msgspec
import structlog
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.websockets import WebSocket

from fullswarm.errors import FullswarmError
from fullswarm.operator.console.api import openapi, problems
from fullswarm.operator.console.api.access import Access, body_of, query_of
from fullswarm.operator.console.api.acts import Actor, Changes
from fullswarm.operator.console.api.problems import ProblemError
from fullswarm.operator.console.api.programs import Programs
from fullswarm.operator.console.api.reads import Reader
from fullswarm.operator.console.api.routes import BASE, OPERATIONS, Operation
from fullswarm.operator.console.api.stream import Stream
from fullswarm.operator.console.gateway import Gateway
from fullswarm.operator.console.tokens import Admitted, Doorkeeper

_log = structlog.get_logger()

Endpoint = Callable[[Request], Awaitable[Response]]


class Api:
    """The interface for programs.

    Parameters
    ----------
    doorkeeper
        Of the tokens of programs: those of pages do not count here.
    process
        Name of this console.
    wake
        Called after something was sent: timers may have been set.
    """

    def __init__(
        self,
        gateway: Gateway,
        doorkeeper: Doorkeeper,
        now_s: Callable[[], float],
        wake: Callable[[], None],
        process: str,
    ) -> None:
        self.access = Access(doorkeeper, now_s, read_only=gateway.context.read_only)
        self.programs = Programs(gateway.context, doorkeeper, process)
        self._gateway, self._now_s, self._wake = gateway, now_s, wake
        self._changes = Changes()
        self.programs.on_change = self._changes.notify
        self._document = msgspec.json.encode(openapi.document())
        self._page = openapi.page()

    def close(self) -> None:
        """Release everything that programs hold."""
        self.programs.close()

    def route(self) -> BaseRoute:
        """Return what the console's application mounts."""
        routes: list[BaseRoute] = [
            Route("/", self._serve_page, methods=["GET"]),
            Route("/openapi.json", self._serve_document, methods=["GET"]),
            WebSocketRoute(openapi.STREAM, self._serve_stream),
            Route(openapi.STREAM, self._needs_websocket, methods=["GET"]),
        ]
        by_path: dict[str, list[Operation]] = {}
        for operation in OPERATIONS:
            by_path.setdefault(operation.path, []).append(operation)
        routes += [Route(path, self._endpoint(found), methods=[each.method for each in found])
                   for path, found in by_path.items()]  # fmt: skip
        handlers = {404: _not_found, 405: _not_allowed}
        app = Starlette(routes=routes, exception_handlers=handlers)
        app.router.redirect_slashes = False
        return Mount(BASE, app=app)

    # ---------------------------------------------------------------- operations
    def _endpoint(self, operations: list[Operation]) -> Endpoint:
        by_method = {each.method: each for each in operations}

        async def endpoint(request: Request) -> Response:
            method = "GET" if request.method == "HEAD" else request.method
            answer = await _answered(lambda: self._call(request, by_method[method]))
            if request.method == "POST" and answer.status_code >= 400:
                # Its body may not have been read: what is left of it would be received without an end.
                answer.headers["Connection"] = "close"
            return answer

        return endpoint

    async def _call(self, request: Request, operation: Operation) -> Response:
        admitted = self.access.caller(request.headers)
        self.access.check(admitted, operation.right)
        # Its token is right: strangers' connections must not displace it.
        request.state.admission.leave()
        with self.access.calling(admitted):
            given: msgspec.Struct | None = None
            if operation.body is not None:
                given = await body_of(request, operation.body)
            elif operation.query is not None:
                given = query_of(request, operation.query)
            reader, actor = self._for(admitted)
            found = await operation.carry_out(reader, actor, dict(request.path_params), given)
        return Response(msgspec.json.encode(found), operation.status, media_type="application/json")

    def _for(self, admitted: Admitted) -> tuple[Reader, Actor]:
        program = self.programs.of(admitted)
        self._wake()  # it may be new, and have set timers
        reader = Reader(self._gateway, program)
        return reader, Actor(reader, program, self.programs, self._changes, self._wake)

    # ---------------------------------------------------------------- others
    async def _serve_page(self, _: Request) -> Response:
        return HTMLResponse(self._page)

    async def _serve_document(self, _: Request) -> Response:
        return Response(self._document, media_type="application/json")

    async def _serve_stream(self, websocket: WebSocket) -> None:
        await Stream(websocket, self.access, self._for, self._now_s).serve()

    async def _needs_websocket(self, _: Request) -> Response:
        error = ProblemError(426, "this address is a WebSocket", where=openapi.STREAM, hint="open it as ws://")
        answer = error.response()
        answer.headers["Upgrade"] = "websocket"
        return answer


async def _answered(call: Callable[[], Awaitable[Response]]) -> Response:
    """Return the answer of a call; whatever goes wrong is a problem, never a trace of the program."""
    try:
        return await call()
    except ProblemError as error:
        return error.response()
    except FullswarmError as error:
        return problems.of_error(error).response()
    except Exception as error:
        _log.error("api.call_failed", error=repr(error), exc_info=True)
        detail = f"{type(error).__name__}, a bug in fullswarm"
        return ProblemError(500, detail, hint="the console's log has more").response()


async def _not_found(request: Request, _: Exception) -> Response:
    hint = f"{BASE}/ lists what there is"
    return ProblemError(404, "no such address", where=request.url.path[:200], hint=hint).response()


async def _not_allowed(request: Request, error: Exception) -> Response:
    hint = f"{BASE}/ lists what there is"
    answer = ProblemError(405, f"{request.method[:16]} is not offered here", where=request.url.path[:200], hint=hint)
    found = answer.response()
    if isinstance(error, HTTPException):
        found.headers.update(error.headers or {})
    return found
