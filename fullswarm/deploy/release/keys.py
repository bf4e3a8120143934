"""Keeps the keys of a base station, and signs and verifies releases with them; ``ssh-keygen`` does the work.

Each key is made when it is first needed, in one folder that no other user may read. A signature is SSHSIG by an
Ed25519 key, which every machine with OpenSSH can verify, as robots do.
"""

from __future__ import annotations

import fcntl
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fullswarm.deploy.release import manifest
from fullswarm.errors import ConfigError
from fullswarm.identity.folder import KEYS, keys_folder, usable

_NAME = re.compile(r"[0-9A-Za-z_][0-9A-Za-z_.-]*")
_SSH_KEYGEN = "ssh-keygen"
NAMESPACE = "fullswarm-release"
"""Ties a signature to its purpose: one for a Git commit by the same key is not one for a release."""
IDENTITY = "fullswarm"


@dataclass(frozen=True, slots=True)
class Keys:
    """The release key signs, the fleet key logs in, a host key is a robot's own; all are Ed25519.

    Keep a backup of the folder: robots trust no other release key.
    """

    folder: Path

    @classmethod
    def default(cls) -> Keys:
        """Return the keys of this user, or of the folder that ``FULLSWARM_KEYS`` names."""
        return cls(keys_folder())

    def release_key(self) -> Path:
        """Return the private key that signs releases."""
        return self._key("release_ed25519", "fullswarm release")

    def fleet_key(self) -> Path:
        """Return the private key that logs in to robots."""
        return self._key("fleet_ed25519", "fullswarm fleet")

    def host_key(self, swarm: str, robot: str) -> Path:
        """Return the private host key of a robot: made here, so that the base knows it before the first connection.

        Raises
        ------
        ConfigError
            A name is not a valid file name.
        """
        return self._key(self._host_key(swarm, robot), f"fullswarm {swarm} {robot}")

    def has_host_key(self, swarm: str, robot: str) -> bool:
        """Return whether one was made here before."""
        with usable(self.folder):
            return (self.folder / self._host_key(swarm, robot)).exists()

    def forget_host_key(self, swarm: str, robot: str) -> None:
        """Remove it, when no card has it."""
        path = self.folder / self._host_key(swarm, robot)
        with usable(self.folder), self._alone():
            path.unlink(missing_ok=True)  # the private half first, because it was made last
            Path(f"{path}.pub").unlink(missing_ok=True)

    def _host_key(self, swarm: str, robot: str) -> str:
        for each in (swarm, robot):
            if not _NAME.fullmatch(each):
                raise ConfigError(f"'{each}' is not a valid file name", hint="letters, digits, - and _")
        return f"hosts/{swarm}/{robot}_ed25519"

    @property
    def known_hosts(self) -> Path:
        """The file of pinned host keys, in OpenSSH's format; it need not exist."""
        return self.folder / "known_hosts"

    def allowed_signers(self) -> str:
        """Return the line by which a robot accepts our signatures."""
        kind, key = public(self.release_key()).split()[:2]
        return f'{IDENTITY} namespaces="{NAMESPACE}" {kind} {key}\n'

    def _key(self, name: str, comment: str) -> Path:
        path = self.folder / name
        with usable(self.folder):
            if not path.exists():
                with self._alone():
                    if not path.exists():
                        _make(path, comment)
            _private(path)
        return path

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Hold the lock: two keys of one name would lock a user out of the fleet."""
        _folder(self.folder)
        with (self.folder / ".lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


def public(key: Path) -> str:
    """Return the public half of a private key: ``ssh-ed25519 AAAA… comment``.

    Raises
    ------
    ConfigError
        The private key cannot be read, or needs a passphrase.
    """
    beside = Path(f"{key}.pub")
    with usable(key.parent):
        if beside.exists():
            return beside.read_text("utf-8").strip()
    return ssh_keygen("-y", "-P", "", "-f", str(key), why=f"read {key}").decode().strip()


def fingerprint(key: Path) -> str:
    """Return ``SHA256:…``, as every SSH tool shows it."""
    return ssh_keygen("-l", "-f", str(key), why=f"read {key}").decode().split()[1]


def _make(path: Path, comment: str) -> None:
    _folder(path.parent)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        fresh = Path(scratch, path.name)
        ssh_keygen("-q", "-t", "ed25519", "-N", "", "-C", comment, "-f", str(fresh), why=f"make {path}")
        # The private half last: once it is there, the key is whole.
        Path(f"{fresh}.pub").replace(f"{path}.pub")
        fresh.replace(path)


def _folder(path: Path) -> None:
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        hint = f"name another folder in {KEYS}"
        raise ConfigError(f"keys cannot be stored here: {error.strerror}", where=str(path), hint=hint) from error


def _private(path: Path) -> None:
    """Refuse a key that others can read, as SSH does."""
    if path.stat().st_mode & 0o077:
        raise ConfigError("other users can read this private key", where=str(path), hint=f"chmod 600 {path}")


# ---------------------------------------------------------------- ssh-keygen
def ssh_keygen(*arguments: str, feed: bytes = b"", why: str) -> bytes:
    """Run ssh-keygen with `feed` as its stdin; return its stdout.

    Raises
    ------
    ConfigError
        It is not installed, or it fails; `why` is the purpose, for the message.
    """
    tool = shutil.which(_SSH_KEYGEN)
    if tool is None:
        raise ConfigError(f"cannot {why}: {_SSH_KEYGEN} is not installed", hint="sudo apt install openssh-client")
    done = subprocess.run([tool, *arguments], input=feed, capture_output=True, check=False)  # noqa: S603 - no shell, fixed arguments
    if done.returncode != 0:
        words = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines()
        raise ConfigError(f"cannot {why}: {_SSH_KEYGEN}: {words[-1] if words else f'exit {done.returncode}'}")
    return done.stdout


# ---------------------------------------------------------------- signatures
def sign_release(folder: Path, key: Path) -> None:
    """Sign the checksums of a release with a private key; the same key gives the same bytes.

    Raises
    ------
    ConfigError
        ssh-keygen is missing or refuses.
    """
    text = (folder / manifest.SUMS).read_bytes()
    made = ssh_keygen("-q", "-Y", "sign", "-n", NAMESPACE, "-f", str(key), feed=text, why=f"sign with {key}")
    (folder / manifest.SIGNATURE).write_bytes(made)


def verify_release(folder: Path, allowed_signers: str) -> None:
    """Check that a release is signed by one of `allowed_signers` and that every file is what was signed.

    Raises
    ------
    ConfigError
        The signature is missing or wrong, or a file was changed, added or removed.
    """
    try:
        text, signature = (folder / manifest.SUMS).read_bytes(), folder / manifest.SIGNATURE
    except OSError as error:
        raise ConfigError("not a complete release: no checksums", where=str(folder), hint="bundle again") from error
    if not signature.is_file():
        raise ConfigError("the release is not signed", where=str(folder), hint="bundle again")
    with tempfile.NamedTemporaryFile("w", encoding="utf-8") as signers:
        signers.write(allowed_signers)
        signers.flush()
        arguments = ("-f", signers.name, "-I", IDENTITY, "-n", NAMESPACE, "-s", str(signature))
        try:
            ssh_keygen("-Y", "verify", *arguments, feed=text, why="verify the signature")
        except ConfigError as error:
            hint = "signed on another base, or changed since; bundle it here"
            raise ConfigError(error.what, where=str(folder), hint=error.hint or hint) from error
    manifest.check_sums(folder)
