"""Signs and verifies texts with SSH keys (SSHSIG); ``ssh-keygen`` does the work, and asks once for a passphrase.

A signature is bound to a namespace, so that one for a release is none for a support package. The private key may have a
passphrase, lie in an ``ssh-agent``, or be on a FIDO security key (``ssh-keygen -t ed25519-sk``).
"""

from __future__ import annotations

import getpass
import os
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from fullswarm.errors import ConfigError

IDENTITY = "fullswarm"
SUMS_NAMESPACE, STATEMENT_NAMESPACE = "fullswarm-release", "fullswarm-statement"
"""Of the checksums of a release, which robots with older tools verify, and of the statement about a release."""
SUPPORT_NAMESPACE, ROOT_NAMESPACE = "fullswarm-support", "fullswarm-root"
BEGIN = "-----BEGIN SSH SIGNATURE-----\n"
_SSH_KEYGEN = "ssh-keygen"
_PASSPHRASE = "FULLSWARM_PASSPHRASE"  # noqa: S105  (the name of a variable)


def ssh_keygen(*arguments: str, feed: bytes = b"", why: str, environment: Mapping[str, str] | None = None) -> bytes:
    """Run ssh-keygen with `feed` as its stdin; return its stdout.

    Raises
    ------
    ConfigError
        It is not installed, or it fails; `why` is the purpose, for the message.
    """
    tool = shutil.which(_SSH_KEYGEN)
    if tool is None:
        raise ConfigError(f"cannot {why}: {_SSH_KEYGEN} is not installed", hint="sudo apt install openssh-client")
    values = {**os.environ, **(environment or {})}
    done = subprocess.run([tool, *arguments], input=feed, capture_output=True, check=False, env=values)  # noqa: S603 - no shell, fixed arguments
    if done.returncode != 0:
        words = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines()
        raise ConfigError(f"cannot {why}: {_SSH_KEYGEN}: {words[-1] if words else f'exit {done.returncode}'}")
    return done.stdout


def sign(text: bytes, namespace: str, key: Path) -> str:
    """Return the signature of a text by a private key; an Ed25519 key gives the same one each time.

    A passphrase is asked once per process, on the terminal, unless an ``ssh-agent`` has the key.

    Raises
    ------
    ConfigError
        ssh-keygen is missing or refuses; or a passphrase is needed and there is no terminal.
    """
    words = ("-q", "-Y", "sign", "-n", namespace, "-f", str(key))
    if _in_agent(key) or not _encrypted(key):
        return ssh_keygen(*words, feed=text, why=f"sign with {key}").decode()
    with tempfile.TemporaryDirectory() as scratch:
        program = Path(scratch, "askpass")
        program.write_text(f'#!/bin/sh\nprintf "%s\\n" "${_PASSPHRASE}"\n', "ascii")
        program.chmod(0o700)
        environment = {
            "SSH_ASKPASS": str(program),
            "SSH_ASKPASS_REQUIRE": "force",
            "DISPLAY": os.environ.get("DISPLAY", ":"),  # older versions ask a program only where there is a display
            _PASSPHRASE: _passphrase(key),
        }
        try:
            return ssh_keygen(*words, feed=text, why=f"sign with {key}", environment=environment).decode()
        except ConfigError:
            _passphrase.cache_clear()  # a wrong one must not be tried again
            raise


@cache
def _passphrase(key: Path) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", getpass.GetPassWarning)  # it would be read from stdin, and shown
            return getpass.getpass(f"Passphrase of {key}: ")
    except (EOFError, OSError, getpass.GetPassWarning) as error:
        hint = f"in a terminal, or once: ssh-add {key}"
        raise ConfigError("this key needs its passphrase", where=str(key), hint=hint) from error


def _encrypted(key: Path) -> bool:
    try:
        ssh_keygen("-y", "-P", "", "-f", str(key), why=f"read {key}")
    except ConfigError as error:
        return "incorrect passphrase" in error.what
    return False


def _in_agent(key: Path) -> bool:
    add, beside = shutil.which("ssh-add"), Path(f"{key}.pub")
    if add is None or "SSH_AUTH_SOCK" not in os.environ or not beside.exists():
        return False
    listed = subprocess.run([add, "-L"], capture_output=True, check=False, text=True)  # noqa: S603 - fixed arguments
    return beside.read_text("utf-8").split()[1] in listed.stdout.split()


def verify(text: bytes, signature: str, namespace: str, allowed_signers: str) -> None:
    """Check that one of `allowed_signers` has signed a text.

    Raises
    ------
    ConfigError
        None of them has, or its key has expired.
    """
    with tempfile.TemporaryDirectory() as scratch:
        signers, made = Path(scratch, "signers"), Path(scratch, "signature")
        signers.write_text(allowed_signers, "utf-8")
        made.write_text(signature, "utf-8")
        words = ("-f", str(signers), "-I", IDENTITY, "-n", namespace, "-s", str(made))
        ssh_keygen("-Y", "verify", *words, feed=text, why="verify the signature")


def split(document: str) -> tuple[str, tuple[str, ...]]:
    """Return the text of a signed document and the signatures that follow it."""
    text, *signatures = document.split(BEGIN)
    return text, tuple(BEGIN + each for each in signatures)
