"""Errors of the interface as ``application/problem+json`` (RFC 9457): what failed, where, and what to do."""

from __future__ import annotations

import math

import msgspec
from starlette.responses import Response

from fullswarm.errors import ConfigError, FullswarmError, RequestRefused, Unreachable
from fullswarm.reasons import Code

MEDIA_TYPE = "application/problem+json"
TITLES = {
    400: "Malformed request", 401: "Token missing or not valid", 403: "Not permitted", 404: "Not found",
    405: "Method not allowed", 408: "Request too slow", 409: "Conflict with the state of the swarm",
    413: "Body too large", 415: "Unsupported media type", 422: "Invalid content", 426: "WebSocket needed",
    429: "Too many requests", 500: "Internal error", 503: "The swarm does not answer",
}  # fmt: skip


class Problem(msgspec.Struct, frozen=True, kw_only=True):
    """An error. `detail` says what failed, `where` the field, robot or option, `hint` what to do."""

    type: str
    title: str
    status: int
    detail: str
    where: str = ""
    hint: str = ""
    code: str = ""
    """The reason as a code, see `fullswarm.reasons`; empty: it has none."""


class ProblemError(Exception):
    """An operation that failed, with its answer."""

    def __init__(
        self, status: int, detail: str, *, where: str = "", hint: str = "", code: str = "", retry_s: float = 0.0
    ) -> None:
        super().__init__(detail)
        self.retry_s = retry_s
        self.problem = Problem(
            type=f"urn:fullswarm:problem:{status}", title=TITLES[status], status=status, detail=detail[:1000],
            where=where[:200], hint=hint[:500], code=code,
        )  # fmt: skip

    def headers(self) -> dict[str, str]:
        """Return the headers that the status asks for."""
        found = {}
        if self.problem.status == 401:
            found["WWW-Authenticate"] = 'Bearer realm="fullswarm"'
        if self.retry_s > 0.0:
            found["Retry-After"] = str(math.ceil(self.retry_s))
        return found

    def response(self) -> Response:
        """Return the answer."""
        return Response(
            msgspec.json.encode(self.problem), self.problem.status, media_type=MEDIA_TYPE, headers=self.headers()
        )


def of_error(error: FullswarmError) -> ProblemError:
    """Return the answer for an error of the package."""
    status = 500
    if isinstance(error, RequestRefused):
        status = 422 if error.code == Code.PARAMETERS else 409
    elif isinstance(error, ConfigError):
        status = 422
    elif isinstance(error, Unreachable):
        status = 503
    return ProblemError(status, error.what, where=error.where, hint=error.hint, code=error.code)
