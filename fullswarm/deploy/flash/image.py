"""Reads images: plain, .xz, .gz, .zst; their checksum; their first part as a sparse file."""

from __future__ import annotations

import errno
import gzip
import hashlib
import lzma
import os
import re
import shutil
import subprocess
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from fullswarm.errors import ConfigError

CHUNK_BYTES = 4 << 20
SUFFIXES = (".img", ".raw", ".xz", ".gz", ".zst")
Report = Callable[[int], None]
"""Called with the number of bytes done so far."""

_HASH = re.compile(r"\b[0-9a-fA-F]{64}\b")
AGAIN = "download it again"


@contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """Open an image for reading as plain bytes, decompressed on the way.

    Raises
    ------
    ConfigError
        It cannot be read, or its compression is unknown here.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        hint = f"images end in {', '.join(SUFFIXES)}; unpack a .zip first"
        raise ConfigError("is not an image that can be written", where=str(path), hint=hint)
    if not path.is_file():
        hint = "download one, e.g. Raspberry Pi OS Lite (64-bit)"
        raise ConfigError("no such file", where=str(path), hint=hint)
    if suffix == ".zst":
        with _zstd(path) as stream:
            yield stream
        return
    openers: dict[str, Callable[..., Any]] = {".xz": lzma.open, ".gz": gzip.open}
    opener = openers.get(suffix, open)
    try:
        with opener(path, "rb") as stream:
            yield stream
    except (lzma.LZMAError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise ConfigError(f"is damaged: {error}", where=str(path), hint=AGAIN) from error


@contextmanager
def _zstd(path: Path) -> Iterator[IO[bytes]]:
    program = shutil.which("zstd")
    if program is None:
        raise ConfigError("needs the program zstd", where=str(path), hint="apt install zstd, or use an .xz image")
    words = [program, "-dcq", str(path)]
    with tempfile.TemporaryFile() as errors, subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors) as process:  # noqa: S603
        assert process.stdout is not None  # noqa: S101
        try:
            yield process.stdout
        except BaseException:
            process.kill()
            raise
        if process.stdout.read(1):  # only the first part was read
            process.kill()
            return
        if process.wait() != 0:
            errors.seek(0)
            message = errors.read().decode("utf-8", "replace").strip()
            raise ConfigError(f"is damaged: {message}", where=str(path), hint=AGAIN)


def chunks(stream: IO[bytes], size: int = CHUNK_BYTES) -> Iterator[bytes]:
    """Yield the content of `stream` in pieces of `size` bytes, the last one shorter."""
    held = bytearray()
    while data := stream.read(size - len(held)):
        held += data
        if len(held) == size:
            yield bytes(held)
            held.clear()
    if held:
        yield bytes(held)


def expected_sha256(path: Path, given: str | None) -> str | None:
    """Return what the image file's SHA-256 must be: as given, else as in the ``.sha256`` file beside it, else None.

    Raises
    ------
    ConfigError
        The option or the file beside it is not a SHA-256.
    """
    if given is not None:
        if not _HASH.fullmatch(given.strip()):
            raise ConfigError(f"'{given:.80}' is not a SHA-256", where="--sha256", hint="64 hexadecimal digits")
        return given.strip().lower()
    beside = path.with_name(f"{path.name}.sha256")
    if not beside.is_file():
        return None
    lines = beside.read_text("utf-8", "replace").splitlines()
    for line in sorted(lines, key=lambda each: path.name not in each):  # a list of many files: ours first
        if found := _HASH.search(line):
            return found[0].lower()
    raise ConfigError("holds no SHA-256", where=str(beside), hint="download it again, or give --sha256")


def file_sha256(path: Path, report: Report) -> str:
    """Return the SHA-256 of a file as it is, compressed or not."""
    digest, done = hashlib.sha256(), 0
    with path.open("rb") as file:
        while data := file.read(CHUNK_BYTES):
            digest.update(data)
            done += len(data)
            report(done)
    return digest.hexdigest()


def check_sha256(path: Path, wanted: str | None, report: Report) -> str:
    """Return the file's SHA-256.

    Raises
    ------
    ConfigError
        It is not `wanted`.
    """
    found = file_sha256(path, report)
    if wanted is not None and found != wanted:
        what = f"its SHA-256 is {found}, not {wanted}"
        raise ConfigError(what, where=str(path), hint=f"{AGAIN}; nothing was written")
    return found


def copy_head(path: Path, upto_bytes: int, into: Path, report: Report = lambda _: None) -> int:
    """Write the first `upto_bytes` of an image, decompressed, into a new sparse file; return how many there were."""
    done = 0
    with opened(path) as stream, into.open("wb") as file:
        for data in chunks(stream):
            piece = data[: upto_bytes - done]
            put_sparse(file.fileno(), piece, done)
            done += len(piece)
            report(done)
            if done >= upto_bytes:
                break
        file.truncate(done)
    return done


def put_sparse(file: int, data: bytes, at_bytes: int, block_bytes: int = 65536) -> None:
    """Write `data` into a fresh file, leaving holes where whole blocks are zero."""
    zero = bytes(block_bytes)
    for begin in range(0, len(data), block_bytes):
        block = data[begin : begin + block_bytes]
        if block != zero[: len(block)]:
            write_all(file, block, at_bytes + begin)


def write_all(file: int, data: bytes, at_bytes: int) -> None:
    """Write all of `data`, however little the kernel accepts at a time.

    Raises
    ------
    OSError
        The file accepts nothing more.
    """
    rest = memoryview(data)
    while rest:
        taken = os.pwrite(file, rest, at_bytes)
        if taken <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        rest, at_bytes = rest[taken:], at_bytes + taken
