"""Tokens of the console: whose they are, what they allow, and how long; kept as hashes in a file for this user only.

A page sends its token once. It gets a pass for `PASS_S` in exchange, which it uses from then on, and a new one while it
is in use. So the token of the address is neither kept by the browser nor sent again, and a page that is left open in an
unlocked room is not the key for ever. A pass is signed with the token's hash: a console that is started again accepts
it, and it ends with its token, when that is revoked, replaced, or too old.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.files import replace_file
from fullswarm.portability import seen_by_others, user_id

Role = Literal["operator", "driver", "observer"]
"""An observer's page shows everything and sends nothing, not even a stop. A driver requests, drives and stops, but
neither clears an e-stop nor takes robots over from their holders."""

PASS_S = 12 * 3600.0
RENEW_S = PASS_S / 2
"""A pass with less time left than this is replaced while its page is open."""
NAME = r"[A-Za-z0-9][A-Za-z0-9_@-]{0,63}"
_PASS = re.compile(r"pass\.([0-9]{1,12})\.([0-9a-f]{64})\Z")


class Token(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One operator's token, as the file has it. Times are seconds since 1970."""

    name: Annotated[str, Meta(pattern=rf"\A{NAME}\Z")]
    role: Role
    sha256: Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
    issued_s: float
    expires_s: float | None = None
    once: bool = False  # it can be exchanged for a pass only once
    used: bool = False


class TokenFile:
    """The tokens of named operators. It is read again when it has changed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read: tuple[tuple[int, int, int] | None, tuple[Token, ...]] = (None, ())

    def tokens(self) -> tuple[Token, ...]:
        """Return all tokens; none if there is no file.

        Raises
        ------
        ConfigError
            The file is none of ours, or others can read or write it.
        """
        try:
            found = self.path.stat()
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise ConfigError(f"the tokens cannot be read: {error.strerror}", where=str(self.path)) from error
        version = found.st_mtime_ns, found.st_ino, found.st_size
        if version != self._read[0]:
            check_private(self.path)
            try:
                tokens = msgspec.json.decode(self.path.read_bytes(), type=tuple[Token, ...])
            except (OSError, msgspec.DecodeError) as error:
                raise ConfigError(f"the tokens cannot be read: {error}", where=str(self.path)) from error
            self._read = version, tokens
        return self._read[1]

    def add(self, name: str, role: Role, now_s: float, *, days: float | None = None, once: bool = False) -> str:
        """Make a token for `name`, in place of the one it has; return it. Only its hash is kept.

        Raises
        ------
        ConfigError
            The name is malformed, or the file cannot be written.
        """
        if not re.fullmatch(NAME, name):
            raise ConfigError(
                f"'{name:.80}' cannot name an operator", hint="letters, digits, '@', '-' and '_', 64 at most"
            )
        token = secrets.token_urlsafe(24)
        expires_s = None if days is None else now_s + 86400.0 * days
        made = Token(name=name, role=role, sha256=digest(token), issued_s=now_s, expires_s=expires_s, once=once)
        self._write([*(each for each in self.tokens() if each.name != name), made])
        return token

    def revoke(self, name: str) -> None:
        """Take away the token of `name`; pages that use it are closed within a second.

        Raises
        ------
        ConfigError
            There is none, or the file cannot be written.
        """
        tokens = self.tokens()
        if name not in (each.name for each in tokens):
            hint = did_you_mean(name, [each.name for each in tokens])
            raise ConfigError(f"no operator '{name:.80}' has a token", where=str(self.path), hint=hint)
        self._write([each for each in tokens if each.name != name])

    def use(self, token: Token) -> None:
        """Note that a token that works once was used."""
        used = msgspec.structs.replace(token, used=True)
        self._write([used if each == token else each for each in self.tokens()])

    def _write(self, tokens: list[Token]) -> None:
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            replace_file(self.path, msgspec.json.format(msgspec.json.encode(tokens)), mode=0o600, sync=True)
        except OSError as error:
            raise ConfigError(f"the tokens cannot be written: {error.strerror}", where=str(self.path)) from error


def check_private(path: Path) -> None:
    """Refuse a file with a secret that others can read or write.

    Raises
    ------
    ConfigError
        They can, or it belongs to another user.
    """
    try:
        found = path.stat()
    except OSError:
        return  # reading it will say why
    if seen_by_others(found.st_mode) or str(found.st_uid) not in (user_id(), "0"):
        raise ConfigError("other users can read this secret", where=str(path), hint=f"chmod 600 {path}")


def digest(token: str) -> str:
    """Return the hash of a token. Tokens are random, so it needs no salt."""
    return hashlib.sha256(token.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Admitted:
    """Who a page belongs to.

    Parameters
    ----------
    name
        The operator; empty: the page may state a name.
    role
        What it may do.
    key
        Of passes for it: another one, or none, means that they have ended.
    """

    name: str
    role: Role
    key: str


class Doorkeeper:
    """Decides which pages may enter.

    Parameters
    ----------
    token
        The console's own token; empty: only those of the file count.
    name
        The operator of the console's own token; empty: each page may state a name.
    file
        Tokens of named operators.
    wall_s
        Seconds since 1970.
    """

    def __init__(
        self, token: str, wall_s: Callable[[], float], *, name: str = "", file: TokenFile | None = None
    ) -> None:
        self._own = Admitted(name, "operator", digest(token)) if token else None
        self._file, self._wall_s = file, wall_s

    def admit(self, given: str) -> Admitted | None:
        """Return whose token or pass this is; None: of no operator, or it has ended."""
        match = _PASS.match(given)
        if match is not None:
            return self._admit_pass(int(match[1]), match[2])
        wanted = digest(given)
        found = None
        if self._own is not None and hmac.compare_digest(wanted, self._own.key):
            return self._own
        for token in self._tokens():
            if hmac.compare_digest(wanted, token.sha256) and not (token.once and token.used):
                found = token
        if found is None or (found.expires_s is not None and found.expires_s <= self._wall_s()):
            return None
        if found.once and self._file is not None:
            try:
                self._file.use(found)
            except ConfigError:  # or it would work twice
                return None
        return _admitted(found)

    def holds(self, admitted: Admitted) -> bool:
        """Tell whether a page may stay: its token was not revoked, replaced, and is not too old."""
        return any(each == admitted for each in self._all())

    def issue(self, admitted: Admitted) -> str:
        """Return a pass for a page that was admitted."""
        until_s = int(self._wall_s() + PASS_S)
        return f"pass.{until_s}.{_signature(admitted, until_s)}"

    def _admit_pass(self, until_s: int, signature: str) -> Admitted | None:
        if until_s <= self._wall_s():
            return None
        found = None
        for each in self._all():
            if hmac.compare_digest(_signature(each, until_s), signature):
                found = each
        return found

    def _all(self) -> Iterable[Admitted]:
        if self._own is not None:
            yield self._own
        now_s = self._wall_s()
        for token in self._tokens():
            if token.expires_s is None or token.expires_s > now_s:
                yield _admitted(token)

    def _tokens(self) -> tuple[Token, ...]:
        try:
            return () if self._file is None else self._file.tokens()
        except ConfigError:
            return ()  # damaged, or open to others meanwhile: it is valid for no operator


def _admitted(token: Token) -> Admitted:
    return Admitted(token.name, token.role, token.sha256)


def _signature(admitted: Admitted, until_s: int) -> str:
    text = f"pass {admitted.name} {until_s}"
    return hmac.new(admitted.key.encode(), text.encode(), hashlib.sha256).hexdigest()
