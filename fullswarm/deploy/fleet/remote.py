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
"""Characters of a robot's answer that fit into a message."""
PROGRAM = '"${FULLSWARM_ROOT-}"/opt/fullswarm/bin/fullswarm-robot'
"""As written in a shell script; only tests change the root."""
BEGIN = "fullswarm-begin"
CHUNK_BYTES = 64 * 1024
ANSWER_BYTES = 4 * 1024 * 1024
STALL_S = 45.0
"""A robot that accepts no data for so long counts as unreachable: 2 MB in flight take 16 s at 1 Mbit/s."""
COMMAND_S = 60.0
OPEN_S = 20.0
CLOSE_S = 3.0
_OURS = (b"fullswarm-robot:", b"install.sh:")
"""The prefixes of our own messages."""
_SUDO = re.compile(rb"sudo(-rs)?: |Sorry, user .* (may not|is not allowed)|\S+ is not in the sudoers file")
_HARMLESS = re.compile(rb"unable to resolve host|unable to send audit message|setrlimit\(|command not found")
"""Warnings of sudo after which it goes on; and a missing program, which is no refusal."""
_NO_SUDO = re.compile(rb"\bsudo: (command )?not found")

Feed = bytes | Path
Line = Callable[[bytes], None]


def clean(raw: bytes | str, limit: int = LINE) -> str:
    """Return one printable line: no escape sequences, no bidirectional tricks, at most `limit` characters."""
    text = raw.decode("utf-8", "replace") if isinstance(raw, bytes) else raw
    # Cut before the slow part: a robot that sends 100 MB takes no more of our time than one that sends a line.
    words = "".join(_printable(each) for each in text[: 4 * limit]).split()
    line = " ".join(words)
    return line if len(line) <= limit else line[: limit - 1] + "…"


def clean_log_line(output: bytes) -> str:
    """Return one line of a log with its spaces, at most 4000 characters of it."""
    return "".join(_printable(each) for each in output.decode("utf-8", "replace").rstrip("\r\n")[:4000])


def last_line(output: bytes) -> str:
    """Return the last line that is not empty: programs print their error there."""
    # Not split at \r, with which some programs end lines.
    lines = [line for line in output[-8192:].split(b"\n") if line.strip(b" \r\t)")]
    return clean(lines[-1]) if lines else ""


def strict_json(output: bytes, kind: type[T], robot: str) -> T:
    """Read JSON into a typed struct.

    Raises
    ------
    MessageError
        It is not JSON, or not of this shape.
    """
    try:
        return msgspec.json.decode(output, type=kind)
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
    """The connection ended under a command: whether the command was carried out is unknown."""


class NoRoot(FullswarmError):
    """The login worked, but root is not permitted."""

    exit_code = 3


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of a command; `code` as in ``fullswarm-robot``: 0 ok, 1 negative, 2 usage, 3 refused, 4 back."""

    code: int
    out: bytes
    err: bytes

    @property
    def words(self) -> str:
        """Why, in one line."""
        return last_line(self.err) or last_line(self.out) or f"exit code {self.code}"


@dataclass(slots=True)
class Remote:
    """A connection that is logged in.

    Parameters
    ----------
    own_key
        It was opened with the user's own key, not the fleet's.
    sent_bytes
        What commands got on stdin so far.
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
        """Run a command of a shell script as root; raises as `program`."""
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
        if refusal := sudo_refusal(answer):
            hint = (
                "the password is wrong, or the user is no sudoer"
                if self.sudo_password is not None
                else "--ask-sudo-password, or let ssh_user be root"
            )
            raise NoRoot(f"may not become root there: {refusal}", where=self.robot, hint=hint)
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
            Time limit after its input was sent; None: no limit. Sending must never stall for `STALL_S`.
        line
            Gets stdout line by line, which is then not part of the answer.

        Raises
        ------
        Unreachable
            It did not end in time, stopped reading its input, or printed too much.
        LinkBroke
            The connection ended before the command did.
        """
        # The login shell may be any; the script is for a POSIX shell.
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
        reading = asyncio.gather(_read(process.stdout, line), _read(process.stderr, None))
        try:
            # All three at a time, or a robot that prints while it reads its input would wait for us, and we for it.
            both: set[asyncio.Future[Any]] = {feeding, reading}
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            if feeding.done():
                feeding.result()
            async with asyncio.timeout(within_s):
                out, err = await reading
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
            reading.cancel()
            process.close()
            await asyncio.gather(feeding, reading, return_exceptions=True)

    async def _feed(self, stdin: Any, first: bytes, feed: Feed) -> None:
        """Write all input, never faster than the robot reads it, then end of file."""
        # A command may end before it has read all of its input, for example because it refuses. Then its exit code
        # counts, not our broken pipe; when the link broke there is no exit code.
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
    """Read to the end; `line` gets whole lines as they arrive."""
    kept = bytearray()
    while chunk := await stream.read(CHUNK_BYTES):
        kept += chunk
        if line is not None:
            *whole, rest = kept.split(b"\n")
            for each in whole:
                line(bytes(each))
            kept = bytearray(rest[-CHUNK_BYTES:])
        elif len(kept) > ANSWER_BYTES:
            raise ValueError(f"printed more than {ANSWER_BYTES // 2**20} MB")
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
    """Return a shell script that runs `words` as root, and what must come first on its stdin.

    A sudo rule without a password may apply, so that sudo never reads the one we send. Hence a marker line before the
    command's own input, which a shell started by sudo reads up to.
    """
    if password is None:
        return f'set -- {words}; if [ "$(id -u)" -eq 0 ]; then exec "$@"; fi; exec sudo -n "$@"', b""
    skip = f'while IFS= read -r l; do [ "$l" = {BEGIN} ] && break; done; exec "$@"'
    script = (
        f'set -- sh -c {shlex.quote(skip)} sh {words}; [ "$(id -u)" -eq 0 ] || set -- sudo -S -p "" "$@"; exec "$@"'
    )
    return script, f"{password}\n{BEGIN}\n".encode()


def sudo_refusal(answer: Answer) -> str:
    """Return the message of sudo, or of a shell without sudo, when the command was not run; empty: it was run.

    1 is the exit code of sudo when it refuses, and also one of the programs that it runs.
    """
    lines = answer.err.splitlines()
    if answer.code == 127:
        messages = [each for each in lines if _NO_SUDO.search(each)]
    elif answer.code == 1 and not answer.out and not any(each.startswith(_OURS) for each in lines):
        messages = [each for each in lines if _SUDO.match(each) and not _HARMLESS.search(each)]
    else:
        return ""
    return clean(messages[-1]) if messages else ""


@contextlib.asynccontextmanager
async def closing(connection: asyncssh.SSHClientConnection) -> AsyncIterator[None]:
    """Close a connection at the end; abort it when it does not close within three seconds."""
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
    """Check that the extra for SSH is installed.

    Raises
    ------
    MissingExtra
        asyncssh is not installed.
    """
    try:
        import asyncssh  # noqa: F401
    except ImportError:
        raise MissingExtra("robots are reached over SSH by asyncssh", hint="pip install 'fullswarm[deploy]'") from None
