"""Finds, checks and replaces the files of a keys folder: whose certificate lies where, and which ones are valid.

::

    <folder>/<swarm>/ authority.pem         certificate of the swarm's authority
                      authority.key         its private key: on the base station only
                      grants.json           the certificates that are valid, for the hub
                      <name>/certificate.pem, key.pem

A folder is readable by its user only, mode 0700, and each file has mode 0600. Files are replaced in one step. A
certificate keeps its path when it is renewed, so that the next connection of its process uses the new one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec
import platformdirs

from fullswarm.errors import ConfigError
from fullswarm.files import replace_file
from fullswarm.identity.credentials import Credentials, Grant, Role, check_grants, read_grants
from fullswarm.identity.private import LONGEST_NAME, check_name, check_private, read_pem, usable
from fullswarm.keys import ROBOT_ID
from fullswarm.portability import lock as lock_file

KEYS = "FULLSWARM_KEYS"
"""Names another folder for all keys of a base station: those of SSH and releases, and the folder below."""
IDENTITY = "FULLSWARM_IDENTITY"
"""Names another folder for certificates; default: ``identity`` in the folder of all keys."""
ISSUED = "FULLSWARM_IDENTITY_ISSUED"
"""Folder with ``authority.pem``, ``certificate.pem`` and ``key.pem`` as `deploy` installed them on a robot."""

AUTHORITY, AUTHORITY_KEY, GRANTS = "authority.pem", "authority.key", "grants.json"
CERTIFICATE, KEY = "certificate.pem", "key.pem"


def keys_folder() -> Path:
    """Return the folder of all keys: the user's own, or the one that ``FULLSWARM_KEYS`` names."""
    named = os.environ.get(KEYS)
    return Path(named) if named else platformdirs.user_config_path("fullswarm") / "keys"


def identity_folder() -> Path:
    """Return the folder of certificates: in the folder of all keys, or the one that ``FULLSWARM_IDENTITY`` names."""
    named = os.environ.get(IDENTITY)
    return Path(named) if named else keys_folder() / "identity"


def certificate_name(operator: str) -> str:
    """Return the name in an operator's certificate: `operator` with ``-`` for what a key cannot have.

    Example: ``anna@lab.local`` becomes ``anna-lab-local``.
    """
    return re.sub(r"[^A-Za-z0-9_-]", "-", operator)[:LONGEST_NAME]


def credentials_for(swarm: str, name: str, role: Role | None = None) -> Credentials:
    """Return the files by which the process `name` of a swarm proves its name, checked to be there and private.

    Parameters
    ----------
    role
        Its role; None: read from the certificate.

    Raises
    ------
    ConfigError
        A file is missing, incomplete or readable by others; the hint is the command that mends it.
    MissingExtra
        `role` is None, or the robot's certificate was replaced, and the package cryptography is not installed.
    """
    found = KeysFolder.of(swarm)
    issued = os.environ.get(ISSUED)
    if issued:
        found.take_over(Path(issued), name)
    return found.credentials(name, role)


def grants_file(swarm: str) -> Path:
    """Return the file with the valid certificates of a swarm, which the hub follows."""
    return KeysFolder.of(swarm).grants_path


@dataclass(frozen=True, slots=True)
class KeysFolder:
    """The files of one swarm.

    Parameters
    ----------
    path
        ``<folder>/<swarm>``; it need not exist.

    Raises
    ------
    ConfigError
        The swarm's name cannot be one.
    """

    path: Path
    swarm: str

    def __post_init__(self) -> None:
        if not ROBOT_ID.match(self.swarm):
            raise ConfigError(f"'{self.swarm}' cannot name a swarm", hint="use letters, digits, '-' and '_'")

    @classmethod
    def of(cls, swarm: str, folder: Path | None = None) -> KeysFolder:
        """Return that of a swarm in `folder`; None: in :func:`identity_folder`."""
        return cls((identity_folder() if folder is None else folder) / swarm, swarm)

    # ------------------------------------------------------------------ places
    @property
    def authority_path(self) -> Path:
        """The certificate of the authority."""
        return self.path / AUTHORITY

    @property
    def authority_key_path(self) -> Path:
        """The private key of the authority."""
        return self.path / AUTHORITY_KEY

    @property
    def grants_path(self) -> Path:
        """The list of valid certificates."""
        return self.path / GRANTS

    def certificate_path(self, name: str) -> Path:
        """Return the path of the certificate of `name`."""
        return self._of(name) / CERTIFICATE

    def key_path(self, name: str) -> Path:
        """Return the path of the private key of `name`."""
        return self._of(name) / KEY

    def _of(self, name: str) -> Path:
        check_name(name)
        return self.path / name

    def names(self) -> tuple[str, ...]:
        """Return the names that have a certificate here, in alphabetical order."""
        return tuple(sorted(each.parent.name for each in self.path.glob(f"*/{CERTIFICATE}")))

    @property
    def has_authority(self) -> bool:
        """Whether the swarm's authority is in this folder, with its private key."""
        return self.authority_key_path.is_file()

    def issue_command(self, name: str, role: Role | None = None) -> str:
        """Return the command that issues a certificate for `name`."""
        return f"fullswarm keys issue {name} --role {role or 'ROLE'} --swarm {self.swarm}"

    # ------------------------------------------------------------------ reading
    def credentials(self, name: str, role: Role | None = None) -> Credentials:
        """Return the files of `name`, checked; see :func:`credentials_for`."""
        check_name(name)
        issue = self.issue_command(name, role)
        if not self.path.is_dir():
            raise ConfigError(
                f"this computer has no certificates for swarm '{self.swarm}'",
                where=str(self.path),
                hint="on the base station: `fullswarm keys init FLEET.toml`; on another computer: copy what "
                f"`{issue} --out DIR` writes there, and name it in {IDENTITY}",
            )
        check_private(self.path)
        certificate, key = self.certificate_path(name), self.key_path(name)
        if not certificate.exists() and not key.exists():
            raise ConfigError(f"'{name}' has no certificate in swarm '{self.swarm}'", where=str(self.path), hint=issue)
        for path in (self.authority_path, certificate, key):
            read_pem(path)
        if role is None:
            from fullswarm.identity.certificates import read_certificate

            role = read_certificate(certificate).role
        return Credentials(name, role, self.authority_path, certificate, key)

    def grants(self) -> tuple[Grant, ...]:
        """Return the valid certificates; none when there is no list yet.

        Raises
        ------
        ConfigError
            The list cannot be read.
        """
        return read_grants(self.grants_path) if self.grants_path.exists() else ()

    # ------------------------------------------------------------------ writing
    def write(self, path: Path, content: bytes) -> None:
        """Replace a file of this folder in one step, mode 0600; make its folder.

        Raises
        ------
        ConfigError
            It cannot be written.
        """
        with usable(self.path, path):
            make_folder(path.parent)
            replace_file(path, content, mode=0o600)

    def write_grants(self, grants: Iterable[Grant]) -> None:
        """Replace the list of valid certificates; the hub follows it within a second.

        Raises
        ------
        ConfigError
            The list is not valid, or cannot be written.
        """
        ordered = sorted(grants, key=lambda each: each.common_name)
        check_grants(ordered, str(self.grants_path))
        lines = ",\n".join(" " + msgspec.json.encode(each).decode() for each in ordered)
        self.write(self.grants_path, f"[\n{lines}\n]\n".encode())

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the folder's lock: two generations of one name must not be made at once."""
        with usable(self.path):
            make_folder(self.path)
            check_private(self.path)
            place = self.path / ".lock"
            place.touch(0o600)
            lock = place.open("a")
        with lock:
            lock_file(lock.fileno(), wait=True)
            yield

    def take_over(self, issued: Path, name: str) -> None:
        """Replace the files of `name` by those that `deploy` installed, if these are of a later issue or renewal.

        Parameters
        ----------
        issued
            Folder with ``authority.pem``, ``certificate.pem`` and ``key.pem``; without them nothing is done.

        Raises
        ------
        ConfigError
            A file of `issued` is incomplete or readable by others.
        """
        names = (AUTHORITY, CERTIFICATE, KEY)
        if not any((issued / each).exists() for each in names):
            return
        new = {each: read_pem(issued / each, hint=f"fullswarm deploy {name} --fleet FLEET.toml") for each in names}
        places = {AUTHORITY: self.authority_path, CERTIFICATE: self.certificate_path(name), KEY: self.key_path(name)}
        if _newer(new, places):
            for each in (AUTHORITY, KEY, CERTIFICATE):  # the certificate last: it is what `_newer` compares
                self.write(places[each], new[each])


def _newer(new: dict[str, bytes], places: dict[str, Path]) -> bool:
    """Tell whether `new` must replace the files at `places`: they are not whole, or of an earlier time."""
    try:
        old = {each: read_pem(path) for each, path in places.items()}
    except ConfigError:
        return True
    if old == new:
        return False
    if (old[KEY], old[AUTHORITY]) != (new[KEY], new[AUTHORITY]):
        return True
    from fullswarm.identity.certificates import parse_certificate

    installed = parse_certificate(new[CERTIFICATE])
    try:
        present = parse_certificate(old[CERTIFICATE])
    except ConfigError:
        return True
    later = (installed.generation, installed.expires_s) > (present.generation, present.expires_s)
    return later or present.public_key != installed.public_key


def make_folder(path: Path) -> None:
    """Make a folder, and those above it that are missing, for this user only."""
    for each in (*reversed(path.parents), path):
        each.mkdir(mode=0o700, exist_ok=True)
