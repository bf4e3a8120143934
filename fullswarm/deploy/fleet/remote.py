"""Runs commands on one robot's computer over SSH: sends input, reads the answer, always within a time limit.

What a robot answers is not trusted: it is bounded, read strictly, and stripped of control characters.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import shlex
import unicodedata
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from fullswarm.errors import FullswarmError, MessageError, MissingExtra, Unreachable

if TYPE_CHECKING:
    import asyncssh

T = TypeVar("T")
LINE = 300
"""Characters of a robot's words that fit into a message."""
PROGRAM = '"${FULLSWARM_ROOT-}"/opt/fullswarm/bin/fullswarm-robot'
"""Word of a shell script; only tests move the root."""
BEGIN = "fullswarm-begin"
CHUNK_BYTES = 64 * 1024
ANSWER_BYTES = 4 * 1024 * 1024
STALL_S = 45.0
"""A robot that takes nothing for so long is as good as gone: 2 MB in flight take 16 s at 1 Mbit/s."""
COMMAND_S = 60.0
OPEN_S = 20.0
CLOSE_S = 3.0
_OURS = (b"fullswarm-robot:", b"install.sh:")
"""The prefix of sudo's own messages."""
_SUDO = re.compile(rb"sudo(-rs)?: |Sorry, user .* (may not|is not allowed)|\S+ is not in the sudoers file")
_HARMLESS = re.compile(rb"unable to resolve host|unable to send audit message|setrlimit\(|command not found")
"""sudo says it and goes on; and a program that is not there is no matter of who may run it."""
_NO_SUDO = re.compile(rb"\bsudo: (command )?not found")

Feed = bytes | Path
Line = Callable[[bytes], None]


def clean(said: bytes | str, limit: int = LINE) -> str:
    """One printable line: no escape sequences, no bidirectional tricks, at most `limit` characters."""
    text = said.decode("utf-8", "replace") if isinstance(said, bytes) else said
    # Cut before the slow part: a robot that sends 100 MB takes no more of our time than one that sends a line.
    words = "".join(_printable(each) for each in text[: 4 * limit]).split()
    line = " ".join(words)
    return line if len(line) <= limit else line[: limit - 1] + "…"


def clean_log_line(said: bytes) -> str:
    """One line of a log with its spaces, at most 4000 characters of it."""
    return "".join(_printable(each) for each in said.decode("utf-8", "replace").rstrip("\r\n")[:4000])


def last_words(said: bytes) -> str:
    """What the last line that is not empty says: programs put what went wrong there."""
    # Not at \r, with which some programs end lines in the midst of ours.
    lines = [line for line in said[-8192:].split(b"\n") if line.strip(b" \r\t)")]
    return clean(lines[-1]) if lines else ""


def strict_json(said: bytes, kind: type[T], robot: str) -> T:
    """Read JSON into a typed struct.

    Raises
    ------
    MessageError
        It is not JSON, or not of this shape.
    """
    try:
        return msgspec.json.decode(said, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        hint = "another program in its place, or another version: `fullswarm deploy` puts ours there"
        raise MessageError(f"its answer cannot be read: {clean(str(error))}", where=robot, hint=hint) from None


def _printable(character: str) -> str:
    # Cc: escape sequences; Cf: right-to-left marks; Co, Cs, Zl, Zp: nothing a terminal should be handed.
    if character == "\t":
        return " "
    return " " if unicodedata.category(character) in ("Cc", "Cf", "Co", "Cs", "Zl", "Zp") else character


# ---------------------------------------------------------------- the connection
class LinkBroke(Unreachable):
    """The connection ended under a command: whether the command was carried out is not known."""


class NoRoot(FullswarmError):
    """We are logged in, but may not become root."""

    exit_code = 3


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command said. `code` as in ``fullswarm-robot``: 0 ok, 1 negative, 2 usage, 3 refused, 4 rolled back."""

    code: int
    out: bytes
    err: bytes

    @property
    def words(self) -> str:
        """Why, in one line."""
        return last_words(self.err) or last_words(self.out) or f"exit code {self.code}"


@dataclass(slots=True)
class Remote:
    """A connection that is logged in.

    Parameters
    ----------
    own_key
        The user's own key opened it, not the fleet's.
    sent_bytes
        What commands were fed so far.
    """

    robot: str
    connection: asyncssh.SSHClientConnection
    sudo_password: str | None = None
    own_key: bool = False
    sent_bytes: int = field(default=0, init=False)

    async def program(
        self, *words: str, feed: Feed = b"", within_s: float | None = COMMAND_S, line: Line | None = None
    ) -> Answer:
        """Run ``fullswarm-robot`` as root.

        Raises
        ------
        NoRoot
            sudo wants a password, or the right one.
        Unreachable, LinkBroke
            As `run`.
        """
        return await self.as_root(f"{PROGRAM} {shlex.join(words)}", feed=feed, within_s=within_s, line=line)

    async def as_root(
        self, words: str, *, feed: Feed = b"", within_s: float | None = COMMAND_S, line: Line | None = None
    ) -> Answer:
        """Run words of a shell script as root; raises as `program`."""
        script, first = root_script(words, self.sudo_password)
        return await self.script_as_root(script, first=first, feed=feed, within_s=within_s, line=line)

    async def script_as_root(
        self,
        script: str,
        *,
        first: bytes,
        feed: Feed = b"",
        within_s: float | None = COMMAND_S,
        line: Line | None = None,
    ) -> Answer:
        """Run a script that ends in one of `root_script`; raises as `program`."""
        answer = await self.run(script, first=first, feed=feed, within_s=within_s, line=line)
        if said := sudo_refusal(answer):
            hint = (
                "the password is wrong, or the user is no sudoer"
                if self.sudo_password is not None
                else "--ask-sudo-password, or let ssh_user be root"
            )
            raise NoRoot(f"may not become root there: {said}", where=self.robot, hint=hint)
        return answer

    async def run(
        self,
        script: str,
        *,
        first: bytes = b"",
        feed: Feed = b"",
        within_s: float | None = COMMAND_S,
        line: Line | None = None,
    ) -> Answer:
        """Run a shell script with `first` and `feed` on its stdin.

        Parameters
        ----------
        within_s
            How long it may take after it was fed; None: for ever. Fed, it must never stall for `STALL_S`.
        line
            Gets stdout line by line, which is then not part of the answer.

        Raises
        ------
        Unreachable
            It did not end in time, took nothing more, or said too much.
        LinkBroke
            The connection ended before the command did.
        """
        # The login shell may be any; what we say is for a POSIX shell.
        command = f"exec sh -c {shlex.quote(script)}"
        try:
            return await self._talk(command, first, feed, line, within_s)
        except TimeoutError:
            hint = "it hangs or is very busy: try again, or look there"
            raise Unreachable("stopped answering in the middle of a command", where=self.robot, hint=hint) from None

    async def _talk(self, command: str, first: bytes, feed: Feed, line: Line | None, within_s: float | None) -> Answer:
        import asyncssh

        try:
            async with asyncio.timeout(OPEN_S):
                process = await self.connection.create_process(command, encoding=None)
        except (asyncssh.Error, OSError) as error:
            raise self._broke(error) from None
        feeding = asyncio.create_task(self._feed(process.stdin, first, feed))
        heard = asyncio.gather(_read(process.stdout, line), _read(process.stderr, None))
        try:
            # All three at a time: a robot that talks while it is fed must not wait for us, nor we for it.
            both: set[asyncio.Future[Any]] = {feeding, heard}
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            if feeding.done():
                feeding.result()
            async with asyncio.timeout(within_s):
                out, err = await heard
                await process.wait_closed()
            if process.exit_status is None:
                raise self._broke(None)
            return Answer(process.exit_status, out, err)
        except TimeoutError:
            raise
        except (asyncssh.Error, OSError) as error:
            raise self._broke(error) from None
        except ValueError as error:
            raise Unreachable(str(error), where=self.robot, hint="is that a robot of ours?") from None
        finally:
            feeding.cancel()
            heard.cancel()
            process.close()
            await asyncio.gather(feeding, heard, return_exceptions=True)

    async def _feed(self, stdin: Any, first: bytes, feed: Feed) -> None:
        """Write everything, never faster than the robot takes it, and say that it was all."""
        # A command may end before it has read all it was meant to get, for one because it refuses. Its exit code
        # tells, not our broken pipe; and when the link broke there is no exit code.
        with contextlib.suppress(BrokenPipeError, ConnectionError):
            for chunk in _chunks(first, feed):
                stdin.write(chunk)
                async with asyncio.timeout(STALL_S):
                    await stdin.drain()
                self.sent_bytes += len(chunk)
            stdin.write_eof()

    def _broke(self, error: Exception | None) -> LinkBroke:
        why = clean(str(error)) if error is not None else ""
        return LinkBroke(f"the link broke{f': {why}' if why else ''}", where=self.robot, hint="try again")


async def _read(stream: Any, line: Line | None) -> bytes:
    """Read to the end; `line` gets whole lines as they come."""
    kept = bytearray()
    while chunk := await stream.read(CHUNK_BYTES):
        kept += chunk
        if line is not None:
            *whole, rest = kept.split(b"\n")
            for each in whole:
                line(bytes(each))
            kept = bytearray(rest[-CHUNK_BYTES:])
        elif len(kept) > ANSWER_BYTES:
            raise ValueError(f"said more than {ANSWER_BYTES // 2**20} MB")
    if line is not None and kept:
        line(bytes(kept))
    return b"" if line is not None else bytes(kept)


def _chunks(first: bytes, feed: Feed) -> Iterator[bytes]:
    if first:
        yield first
    if isinstance(feed, Path):
        with feed.open("rb") as file:
            while chunk := file.read(CHUNK_BYTES):
                yield chunk
        return
    for start in range(0, len(feed), CHUNK_BYTES):
        yield feed[start : start + CHUNK_BYTES]


def root_script(words: str, password: str | None) -> tuple[str, bytes]:
    """Shell script that runs `words` as root, and what must come first on its stdin.

    A rule without a password may hold for the command, so that sudo never reads the one we send. Hence a line
    that says where the command's own input begins, read by a shell behind sudo.
    """
    if password is None:
        return f'set -- {words}; if [ "$(id -u)" -eq 0 ]; then exec "$@"; fi; exec sudo -n "$@"', b""
    skip = f'while IFS= read -r l; do [ "$l" = {BEGIN} ] && break; done; exec "$@"'
    script = (
        f'set -- sh -c {shlex.quote(skip)} sh {words}; [ "$(id -u)" -eq 0 ] || set -- sudo -S -p "" "$@"; exec "$@"'
    )
    return script, f"{password}\n{BEGIN}\n".encode()


def sudo_refusal(answer: Answer) -> str:
    """What sudo, or the shell that finds no sudo, said instead of running the command; empty: it was run.

    1 is what sudo ends with when it refuses, and also an answer of the programs that it runs.
    """
    lines = answer.err.splitlines()
    if answer.code == 127:
        said = [each for each in lines if _NO_SUDO.search(each)]
    elif answer.code == 1 and not answer.out and not any(each.startswith(_OURS) for each in lines):
        said = [each for each in lines if _SUDO.match(each) and not _HARMLESS.search(each)]
    else:
        return ""
    return clean(said[-1]) if said else ""


@contextlib.asynccontextmanager
async def closing(connection: asyncssh.SSHClientConnection) -> AsyncIterator[None]:
    """Close a connection at the end, politely for three seconds."""
    try:
        yield
    finally:
        connection.close()
        try:
            async with asyncio.timeout(CLOSE_S):
                await connection.wait_closed()
        except TimeoutError:
            connection.abort()


def need_asyncssh() -> None:
    """Say at once, and once, that SSH needs the extra.

    Raises
    ------
    MissingExtra
        asyncssh is not installed.
    """
    try:
        import asyncssh  # noqa: F401
    except ImportError:
        raise MissingExtra("robots are reached over SSH by asyncssh", hint="pip install 'fullswarm[deploy]'") from None
