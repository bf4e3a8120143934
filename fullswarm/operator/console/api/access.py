"""Controls access to the interface: whose token a call has, what its role permits, how often and how much it may send.

Host and Origin are checked before, by the console's own guard: a program sends no Origin, and a browser's page of
another origin is refused.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar
from urllib.parse import parse_qsl

import msgspec
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request

from fullswarm.operator.console.access import Bucket
from fullswarm.operator.console.api.problems import ProblemError
from fullswarm.operator.console.frames import MAX_BYTES, fits
from fullswarm.operator.console.sessions import READ_ONLY, refusal_of
from fullswarm.operator.console.tokens import Admitted, Doorkeeper
from fullswarm.recent import Recent

T = TypeVar("T", bound=msgspec.Struct)

Right = Literal["read", "change", "stop", "clear"]
"""What an operation needs: `stop` is a change with a rate of its own, `clear` releases e-stops."""

RATE_HZ, BURST = 50.0, 100.0
STOP_RATE_HZ, STOP_BURST = 10.0, 30.0
"""Stops and e-stops have their own, so that no other call can use it up. Each is repeated on the bus."""
MOST_AT_ONCE = 16
MOST_STREAMS = 4
BODY_S = 3.0
JSON, FORM, FIELD = "application/json", "application/x-www-form-urlencoded", "json"
LONGEST_TOKEN = 512
MOST_TOKENS = 1024
WRONG_TOKEN = "the token is unknown, expired or revoked"  # noqa: S105  (a text)


@dataclass(slots=True)
class Usage:
    """What the calls with one token use now."""

    calls: Bucket = field(default_factory=lambda: Bucket(RATE_HZ, BURST))
    stops: Bucket = field(default_factory=lambda: Bucket(STOP_RATE_HZ, STOP_BURST))
    at_once: int = 0
    streams: int = 0


class Access:
    """Decides which calls are carried out.

    Parameters
    ----------
    read_only
        The console only shows: no call changes anything.
    """

    def __init__(self, doorkeeper: Doorkeeper, now_s: Callable[[], float], *, read_only: bool) -> None:
        self.doorkeeper, self._now_s, self._read_only = doorkeeper, now_s, read_only
        self._usage: Recent[str, Usage] = Recent(MOST_TOKENS)

    def caller(self, headers: Headers) -> Admitted:
        """Return whose token the header Authorization has.

        Raises
        ------
        ProblemError
            401: it has none that is valid.
        """
        given = headers.getlist("authorization")
        scheme, _, token = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        if scheme.lower() != "bearer" or not token.strip():
            raise ProblemError(
                401, "a call needs a token", where="Authorization",
                hint="send `Authorization: Bearer TOKEN`; `fullswarm console tokens add NAME --api` makes one",
            )  # fmt: skip
        return self.admit(token.strip())

    def admit(self, token: str) -> Admitted:
        """Return whose token this is.

        Raises
        ------
        ProblemError
            401: it is unknown, expired or revoked.
        """
        found = self.doorkeeper.admit(token) if len(token) <= LONGEST_TOKEN else None
        if found is None or not found.name:
            hint = "ask for a new one: `fullswarm console tokens add NAME --api`"
            raise ProblemError(401, WRONG_TOKEN, where="Authorization", hint=hint)
        return found

    def check(self, admitted: Admitted, right: Right) -> None:
        """Count a call, and check what its role permits.

        Raises
        ------
        ProblemError
            429: calls come too fast; 403: the role does not permit it, or the console only shows.
        """
        usage = self.usage(admitted)
        bucket = usage.stops if right == "stop" else usage.calls
        if not bucket.take(self._now_s()):
            rate_hz = bucket.rate_hz
            raise ProblemError(
                429, f"more than {rate_hz:g} calls per second", hint="wait, then call again", retry_s=1.0
            )
        if right != "read":
            self.check_change(admitted, clears=right == "clear")

    def check_change(self, admitted: Admitted, *, clears: bool = False) -> None:
        """Check that a caller may change something.

        Raises
        ------
        ProblemError
            403: its role does not permit it, or the console only shows.
        """
        if self._read_only:
            raise ProblemError(403, READ_ONLY, where="console")
        self.check_role(admitted, clears=clears)

    @staticmethod
    def check_role(admitted: Admitted, *, clears: bool = False, takes: bool = False) -> None:
        """Check what a role permits, by the rule of the page.

        Raises
        ------
        ProblemError
            403: it does not.
        """
        if reason := refusal_of(admitted.role, clears=clears, takes=takes):
            raise ProblemError(403, reason, where=admitted.role, hint="use a token of another role")

    @contextmanager
    def calling(self, admitted: Admitted) -> Iterator[None]:
        """Count a call while it is carried out.

        Raises
        ------
        ProblemError
            429: enough are.
        """
        usage = self.usage(admitted)
        if usage.at_once >= MOST_AT_ONCE:
            raise ProblemError(429, f"{MOST_AT_ONCE} calls are being carried out", hint="wait for them", retry_s=1.0)
        usage.at_once += 1
        try:
            yield
        finally:
            usage.at_once -= 1

    def usage(self, admitted: Admitted) -> Usage:
        """Return what the calls with a token use."""
        found = self._usage.get(admitted.key)
        if found is None:
            found = self._usage[admitted.key] = Usage()
        return found


async def body_of(request: Request, kind: type[T]) -> T:
    """Return the body of a request as a record.

    Raises
    ------
    ProblemError
        It is too large (413), too slow (408), not JSON (400, 415), or not such a record (422).
    """
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media not in (JSON, FORM):
        raise ProblemError(415, f"the body is '{media[:64]}'", where="Content-Type", hint=f"send {JSON}")
    declared = request.headers.get("content-length", "0")
    if declared.isdecimal() and int(declared) > MAX_BYTES:
        raise _too_large()
    data = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for part in request.stream():
                data += part
                if len(data) > MAX_BYTES:
                    raise _too_large()
    except TimeoutError:
        raise ProblemError(408, f"the body did not arrive within {BODY_S:g} s", where="body") from None
    except ClientDisconnect:
        raise ProblemError(400, "the body ended early", where="body") from None
    return decoded(bytes(data) if media == JSON else _of_form(bytes(data)), kind)


def _of_form(data: bytes) -> bytes:
    """Return the JSON in the one field of a form: GNU Octave can send nothing else."""
    try:
        ((name, value),) = parse_qsl(data, keep_blank_values=True, strict_parsing=True, max_num_fields=1)
    except ValueError:
        raise ProblemError(400, "not a form with one field", where="body", hint=f"send {JSON}, or json=...") from None
    if name != FIELD.encode():
        raise ProblemError(422, f"the field of a form is '{FIELD}'", where="body", hint=f"send {JSON}")
    return value


def decoded(data: bytes | str, kind: type[T] | Any) -> T:
    """Return JSON as a record.

    Raises
    ------
    ProblemError
        400: it is no JSON; 422: it is not such a record.
    """
    try:
        found: T = msgspec.json.decode(data, type=kind)
    except msgspec.ValidationError as error:
        raise _invalid(error, "body") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProblemError(400, f"not JSON: {error}"[:300], where="body", hint="see /api/v1/openapi.json") from None
    for name, value in getattr(found, "parameters", {}).items():
        if not fits(value):
            raise ProblemError(422, f"{name} is too large a number or too long a text", where=f"parameters.{name}")
    return found


def query_of(request: Request, kind: type[T]) -> T:
    """Return the query of a request as a record.

    Raises
    ------
    ProblemError
        422: it is not such a record, or has a name twice.
    """
    items = request.query_params.multi_items()
    given = dict(items)
    if len(given) < len(items):
        raise ProblemError(422, "a parameter is given twice", where="query")
    try:
        return msgspec.convert(given, kind, strict=False)
    except msgspec.ValidationError as error:
        raise _invalid(error, "query") from None


def _invalid(error: msgspec.ValidationError, where: str) -> ProblemError:
    what, _, path = str(error).partition(" - at `$")
    return ProblemError(
        422, what[:300], where=f"{where}{path.rstrip('`')}"[:200], hint="/api/v1/openapi.json describes it"
    )


def _too_large() -> ProblemError:
    return ProblemError(413, f"the body has more than {MAX_BYTES} bytes", where="body")
