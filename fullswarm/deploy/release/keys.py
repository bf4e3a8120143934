"""Keeps the keys of a base station and what robots trust, and signs and verifies releases with them.

Each key is made when it is first needed, in one folder that no other user may read::

    release_ed25519       signs releases and support packages
    root/1_ed25519 …      three root keys, of which two change what robots trust: keep them on separate media
    trust/1.root …        all versions of the root metadata (``trust.py``)
    fleet_ed25519         logs in to robots
    number                the last number of a statement
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.signatures import (
    ROOT_NAMESPACE,
    STATEMENT_NAMESPACE,
    SUMS_NAMESPACE,
    sign,
    split,
    ssh_keygen,
    verify,
)
from fullswarm.deploy.release.trust import (
    KEY_LIFE_S,
    RELEASE_LIFE_S,
    ROOT_LIFE_S,
    ReleaseKey,
    Root,
    Statement,
    check_successor,
    day_of,
)
from fullswarm.errors import ConfigError
from fullswarm.files import replace_file
from fullswarm.identity.folder import KEYS, keys_folder
from fullswarm.identity.private import usable
from fullswarm.portability import lock as lock_file

_NAME = re.compile(r"[0-9A-Za-z_][0-9A-Za-z_.-]*")
_RELEASE = "release_ed25519"
ROOT_KEYS, THRESHOLD = 3, 2
"""Of the first root metadata: one root key may be lost, and one may be stolen."""


@dataclass(frozen=True, slots=True)
class Keys:
    """Release key: signs. Root keys: change what robots trust. Fleet key: logs in. Host keys: the robots' own.

    Keep a backup of the folder: robots trust no other keys.
    """

    folder: Path

    @classmethod
    def default(cls) -> Keys:
        """Return the keys of this user, or of the folder that ``FULLSWARM_KEYS`` names."""
        return cls(keys_folder())

    def release_key(self) -> Path:
        """Return the private key that signs releases and support packages."""
        return self._key(_RELEASE, "fullswarm release")

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
        """Return the keys whose releases robots accept now, as OpenSSH's ``allowed_signers``."""
        return self.root().allowed_signers(time.time())

    # ------------------------------------------------------------ what robots trust
    def roots(self) -> tuple[str, ...]:
        """Return all versions of the root metadata with their signatures, the first one first; make that if needed.

        Raises
        ------
        ConfigError
            A version is missing or damaged.
        """
        with usable(self.folder):
            found = [each.stem for each in self._root_file(1).parent.glob("*.root")]
            if not found:
                self._first_root()
            last = max((int(each) for each in found if each.isdecimal()), default=1)
            files = [self._root_file(each + 1) for each in range(last)]
            if absent := [each for each in files if not each.exists()]:
                raise ConfigError("a version of the root metadata is missing", where=str(absent[0]), hint="restore it")
            return tuple(each.read_text("ascii") for each in files)

    def root(self) -> Root:
        """Return the newest root metadata."""
        documents = self.roots()
        return Root.parse(documents[-1], str(self._root_file(len(documents))))

    def signing_key(self) -> Path:
        """Return the release key, which robots must trust and which must not have expired.

        Raises
        ------
        ConfigError
            Otherwise.
        """
        key, root = self.release_key(), self.root()
        ours = next((each for each in root.releases if each.key == bare_key(key)), None)
        hint = "`fullswarm signing rotate`"
        if ours is None:
            raise ConfigError("robots do not trust this release key", where=str(key), hint=hint)
        if ours.until_s <= time.time():
            raise ConfigError(f"this release key expired on {day_of(ours.until_s)}", where=str(key), hint=hint)
        if root.expires_s <= time.time():
            raise ConfigError(f"the root metadata expired on {day_of(root.expires_s)}", where="signing", hint=hint)
        return key

    def next_number(self) -> int:
        """Return a number for a statement: the time in seconds, always more than the last one."""
        with usable(self.folder), self._alone():
            file, last = self.folder / "number", 0
            with suppress(FileNotFoundError, ValueError):
                last = int(file.read_text("ascii"))
            number = max(int(time.time()), last + 1)
            replace_file(file, f"{number}\n")
            return number

    def change_root(self, change: Callable[[Root], Root], root_keys: Sequence[Path] = ()) -> Root:
        """Sign the next version of the root metadata with all root keys that are here; return it.

        Parameters
        ----------
        change
            Returns what shall differ; version and expiry are set here.
        root_keys
            Private root keys on other media.

        Raises
        ------
        ConfigError
            Fewer root keys are here than the present and the next version need; nothing was changed.
        """
        before = self.root()
        after = replace(change(before), version=before.version + 1, expires_s=int(time.time()) + ROOT_LIFE_S)
        after.check()
        document = self._signed_root(after, {*before.roots, *after.roots}, root_keys)
        check_successor(before, document)
        with usable(self.folder), self._alone():
            replace_file(self._root_file(after.version), document)
        return after

    def rotate_release_key(
        self, fresh: Path | None = None, root_keys: Sequence[Path] = (), *, revoked: Sequence[str] = ()
    ) -> Root:
        """Make another key the release key, and let robots trust it; return the root metadata.

        Parameters
        ----------
        fresh
            A private key with its ``.pub``, such as one with a passphrase or of a FIDO security key; None: make one.
        revoked
            Keys that robots shall no longer trust, as ``ssh-ed25519 AAAA…``; the others stay until they expire.

        Raises
        ------
        ConfigError
            Too few root keys are here, or `fresh` is not a private key with its ``.pub``.
        """
        now = self.folder / f"{_RELEASE}.next"
        self.release_key()
        with usable(self.folder):
            for each in (now, Path(f"{now}.pub")):
                each.unlink(missing_ok=True)
            if fresh is None:
                _make(now, "fullswarm release")
            else:
                bare_key(fresh)
                for end in (".pub", ""):
                    shutil.copyfile(f"{fresh}{end}", f"{now}{end}")
                    Path(f"{now}{end}").chmod(0o600)
            key = ReleaseKey(bare_key(now), int(time.time()) + KEY_LIFE_S)

            def change(before: Root) -> Root:
                kept = [each for each in before.releases if each.key not in {*revoked, key.key}]
                return replace(before, releases=(key, *(each for each in kept if each.until_s > time.time())))

            root = self.change_root(change, root_keys)
            old = self.folder / "old" / f"release-until-{root.version}_ed25519"
            _folder(old.parent)
            for end in ("", ".pub"):
                Path(f"{self.folder / _RELEASE}{end}").replace(f"{old}{end}")
                Path(f"{now}{end}").replace(f"{self.folder / _RELEASE}{end}")
        return root

    def private_files(self) -> dict[str, Path]:
        """Return the private release and root keys that are in the folder, by their public half."""
        found = [each for each in self.folder.glob("root/*") if each.suffix != ".pub"]
        return {bare_key(each): each for each in (self.release_key(), *sorted(found))}

    def _root_file(self, version: int) -> Path:
        return self.folder / "trust" / f"{version}.root"

    def _first_root(self) -> None:
        release = ReleaseKey(bare_key(self.release_key()), int(time.time()) + KEY_LIFE_S)
        made = [self._key(f"root/{each + 1}_ed25519", f"fullswarm root {each + 1}") for each in range(ROOT_KEYS)]
        keys = tuple(bare_key(each) for each in made)
        root = Root(1, int(time.time()) + ROOT_LIFE_S, THRESHOLD, keys, (release,))
        document = self._signed_root(root, set(keys), ())
        with self._alone():
            _folder(self._root_file(1).parent)
            if not self._root_file(1).exists():
                replace_file(self._root_file(1), document)

    def _signed_root(self, root: Root, wanted: set[str], more: Sequence[Path]) -> str:
        keys = {**self.private_files(), **{bare_key(each): each for each in more}}
        made = [sign(root.text.encode(), ROOT_NAMESPACE, keys[each]) for each in sorted(wanted & keys.keys())]
        return root.text + "".join(made)

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
            lock_file(lock.fileno(), wait=True)
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


def bare_key(key: Path) -> str:
    """Return the public half of a private key without its comment."""
    return " ".join(public(key).split()[:2])


def fingerprint_of(key: str) -> str:
    """Return ``SHA256:…`` of a public key."""
    return ssh_keygen("-l", "-f", "-", feed=f"{key}\n".encode(), why="read a public key").decode().split()[1]


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


# ---------------------------------------------------------------- signatures
def sign_release(folder: Path, keys: Keys, *, older: bool = False) -> None:
    """Sign the checksums of a release and the statement about it: a new number, and a new time until which it holds.

    Parameters
    ----------
    older
        Say that robots may go back to this release.

    Raises
    ------
    ConfigError
        ssh-keygen is missing or refuses, or robots do not trust the release key.
    """
    key = keys.signing_key()
    text, made = (folder / manifest.SUMS).read_bytes(), folder.stat()
    signature = folder / manifest.SIGNATURE
    if not older or not signature.exists():
        replace_file(signature, sign(text, SUMS_NAMESPACE, key))  # of robots with older tools
    number = keys.next_number()
    name, digest = manifest.Manifest.read(folder).id, manifest.digest_of(folder / manifest.SUMS)
    statement = Statement(name, number, max(number, int(time.time())) + RELEASE_LIFE_S, digest, older).text
    replace_file(folder / manifest.STATEMENT, statement + sign(statement.encode(), STATEMENT_NAMESPACE, key))
    os.utime(folder, ns=(made.st_atime_ns, made.st_mtime_ns))  # by which the store knows the latest release


def verify_release(folder: Path, allowed_signers: str) -> None:
    """Check that a release and its statement are signed by `allowed_signers`, in time, and that every file is there.

    Raises
    ------
    ConfigError
        A signature is missing or wrong, the statement has expired or is about another release, or a file was changed,
        added or removed.
    """
    verify_sums(folder, allowed_signers)
    again = (
        f"`fullswarm bundle` again, or `fullswarm update --release {folder.name} --allow-older` to sign this one anew"
    )
    try:
        document = (folder / manifest.STATEMENT).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        what = "the release has no signed statement: an older fullswarm made it"
        raise ConfigError(what, where=str(folder), hint=again) from error
    statement = Statement.parse(document, str(folder / manifest.STATEMENT))
    _verify(document, STATEMENT_NAMESPACE, allowed_signers, folder)
    digest = manifest.digest_of(folder / manifest.SUMS)
    if statement.release != manifest.Manifest.read(folder).id or statement.sums != digest:
        raise ConfigError("its statement is about another release", where=str(folder), hint=again)
    if statement.expires_s <= time.time():
        raise ConfigError(f"its signature expired on {day_of(statement.expires_s)}", where=str(folder), hint=again)
    manifest.check_sums(folder)


def verify_sums(folder: Path, allowed_signers: str) -> None:
    """Check that one of `allowed_signers` has signed the checksums of a release, at whatever time.

    Raises
    ------
    ConfigError
        The signature is missing or wrong.
    """
    try:
        text, signature = (folder / manifest.SUMS).read_text("utf-8"), folder / manifest.SIGNATURE
    except OSError as error:
        raise ConfigError("not a complete release: no checksums", where=str(folder), hint="bundle again") from error
    if not signature.is_file():
        raise ConfigError("the release is not signed", where=str(folder), hint="bundle again")
    _verify(text + signature.read_text("utf-8"), SUMS_NAMESPACE, allowed_signers, folder)


def _verify(document: str, namespace: str, allowed_signers: str, folder: Path) -> None:
    text, signatures = split(document)
    try:
        verify(text.encode(), "".join(signatures), namespace, allowed_signers)
    except ConfigError as error:
        hint = "signed on another base, by a revoked or expired key, or changed since; bundle it here"
        raise ConfigError(error.what, where=str(folder), hint=error.hint or hint) from error
