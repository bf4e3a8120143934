"""Makes a swarm's authority; issues, renews, revokes and lists the certificates of its processes and people.

The authority is a private key in the keys folder of the base station. A certificate is valid while it has not
expired and the list of grants names its CN: leaving a CN out revokes it, which needs no private key.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fullswarm.audit.log import Event, record
from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.identity import certificates
from fullswarm.identity.certificates import DAY_S, Certificate, when
from fullswarm.identity.credentials import Credentials, Grant, Role, check_grants
from fullswarm.identity.folder import KeysFolder
from fullswarm.identity.private import check_name, check_private, read_pem
from fullswarm.portability import user_id

AUTHORITY_DAYS = 3650.0
DAYS = 30.0
LONGEST_DAYS = 3650.0
SKEW = 0.01
"""Share of its life by which a certificate begins before it is issued, for clocks that are slow."""
AUDIT = "keys.audit"
"""Folder of the audit log in a swarm's keys; no process can be called so."""
LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a list of certificates.

    Parameters
    ----------
    certificate
        None: its file cannot be read.
    problem
        Why it cannot be used; empty when it can.
    """

    name: str
    certificate: Certificate | None
    revoked: bool
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Authority:
    """The authority of one swarm, able to sign.

    Parameters
    ----------
    wall_s
        Returns seconds since 1970.
    """

    folder: KeysFolder
    _certificate: x509.Certificate
    _key: ec.EllipticCurvePrivateKey
    _wall_s: Callable[[], float] = wall_time_s

    # ------------------------------------------------------------------ making and opening
    @classmethod
    def make(
        cls,
        folder: KeysFolder,
        *,
        days: float = AUTHORITY_DAYS,
        passphrase: str | None = None,
        wall_s: Callable[[], float] = wall_time_s,
    ) -> Authority:
        """Make a swarm's authority, or open the one that there is.

        Parameters
        ----------
        days
            Its life; no certificate outlives it.
        passphrase
            Encrypts the private key; certificates are then not renewed without a person.

        Raises
        ------
        ConfigError
            A file cannot be read or written, or the passphrase is wrong.
        """
        _check_days(days, 10 * LONGEST_DAYS)
        with folder.alone():
            if folder.has_authority:
                return cls.open(folder, passphrase=passphrase, wall_s=wall_s)
            if folder.authority_path.exists() and folder.names():
                what = "the authority's private key is missing, and processes have certificates of it"
                hint = "restore the folder from your backup, or move it away to begin anew with all robots"
                raise ConfigError(what, where=str(folder.authority_key_path), hint=hint)
            now_s = wall_s()
            key = ec.generate_private_key(ec.SECP256R1())
            name = x509.Name(
                [
                    x509.NameAttribute(NameOID.COMMON_NAME, "fullswarm authority"),
                    x509.NameAttribute(NameOID.ORGANIZATION_NAME, folder.swarm),
                ]
            )
            usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
            certificate = (
                x509.CertificateBuilder()
                .subject_name(name)
                .issuer_name(name)
                .public_key(key.public_key())
                .serial_number(x509.random_serial_number())
                .not_valid_before(when(now_s - DAY_S))
                .not_valid_after(when(now_s + days * DAY_S))
                .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
                .add_extension(usage, critical=True)
                .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
                .sign(key, hashes.SHA256())
            )
            folder.write(folder.authority_path, certificate.public_bytes(serialization.Encoding.PEM))
            # The private key last: once it is there, the authority is complete.
            folder.write(folder.authority_key_path, certificates.private_pem(key, passphrase))
        return cls(folder, certificate, key, wall_s)

    @classmethod
    def open(
        cls, folder: KeysFolder, *, passphrase: str | None = None, wall_s: Callable[[], float] = wall_time_s
    ) -> Authority:
        """Open the authority of a swarm.

        Raises
        ------
        ConfigError
            It is not here, its files are damaged, or the passphrase is wrong.
        """
        path = folder.authority_key_path
        if not path.exists():
            raise ConfigError(
                f"the authority of swarm '{folder.swarm}' is not on this computer",
                where=str(folder.path),
                hint="`fullswarm keys init FLEET.toml` makes it on the base station",
            )
        check_private(folder.path)
        restore = "restore the folder from your backup"
        certificate = x509.load_pem_x509_certificate(read_pem(folder.authority_path, restore))
        key = certificates.load_key(read_pem(path, restore), str(path), passphrase)
        if key.public_key() != certificate.public_key():
            raise ConfigError("the authority's key does not belong to its certificate", where=str(path), hint=restore)
        return cls(folder, certificate, key, wall_s)

    # ------------------------------------------------------------------ certificates
    def issue(
        self, name: str, role: Role, *, days: float | None = None, hosts: Iterable[str] = ()
    ) -> tuple[Credentials, bool]:
        """Make a key and a certificate for `name`, unless it has a valid one of this role.

        What `name` had before is no longer valid.

        Parameters
        ----------
        days
            Its life; None: 30 days.
        hosts
            For a hub: further names and addresses at which clients reach it.

        Returns
        -------
        tuple
            Its files, and whether they are new.

        Raises
        ------
        ConfigError
            The name is not valid or has a certificate of another role, or a file cannot be written.
        """
        check_name(name)
        life = DAYS if days is None else days
        _check_days(life)
        with self.folder.alone():
            before, grants = self._before(name), self.folder.grants()
            for each in grants:
                if each.name == name and each.role != role:
                    hint = f"fullswarm keys revoke {name} --swarm {self.folder.swarm}; then issue it again"
                    where = str(self.folder.certificate_path(name))
                    raise ConfigError(f"'{name}' has a certificate as {each.role}", where=where, hint=hint)
            valid = before is not None and self._is_granted(before)
            wanted = _hub_hosts(hosts, before if valid else None) if role == "hub" else ()
            if before is not None and valid and self._has_key(before):
                new = before.expires_s <= self._wall_s() or not set(wanted) <= set(before.hosts)
                if new:
                    self._renew(before, days=days, hosts=wanted)
            else:
                new = True
                self._issue(name, role, life, wanted, before)
        return self.folder.credentials(name, role), new

    def renew(self, name: str, *, days: float | None = None) -> Certificate:
        """Replace the certificate of `name` by one with the same name, role and key, and a new life.

        Parameters
        ----------
        days
            Its life; None: as long as before.

        Raises
        ------
        ConfigError
            It has none, or it is revoked.
        """
        if days is not None:
            _check_days(days)
        with self.folder.alone():
            return self._renew(self._valid(name), days=days)

    def renew_due(self) -> tuple[Certificate, ...]:
        """Renew what is here and past two thirds of its life; return the new certificates.

        What cannot be read is left out: `list` names it.
        """
        now_s = self._wall_s()
        found = [each.certificate for each in list_certificates(self.folder, now_s) if not each.revoked]
        return tuple(self.renew(each.name) for each in found if each is not None and each.due_s <= now_s)

    def answer(self, name: str, request: bytes) -> bytes:
        """Return the newest certificate of `name` for its signing request; renew it first if that is due.

        Parameters
        ----------
        name
            The sender, as the bus states it.
        request
            Signing request in PEM.

        Raises
        ------
        ConfigError
            It is not for the present certificate of `name` and its key, or that is revoked.
        """
        common_name, public_key = certificates.parse_request(request)
        with self.folder.alone():
            present = self._valid(name)
            if common_name != present.common_name or public_key != present.public_key:
                raise ConfigError(
                    f"'{name}' asks for {common_name:.80} with a key that was not issued to it",
                    where=str(self.folder.certificate_path(name)),
                    hint=f"if it was replaced: fullswarm keys revoke {name}; fullswarm keys issue {name}",
                )
            if present.due_s <= self._wall_s():
                self._renew(present)
            return read_pem(self.folder.certificate_path(name))

    # ------------------------------------------------------------------ inside
    def _issue(self, name: str, role: Role, days: float, hosts: Sequence[str], before: Certificate | None) -> None:
        # The time as generation: it is never repeated, even if files were removed or restored from a backup.
        used = [0 if before is None else before.generation]
        used += [certificates.generation_of(each.common_name) for each in self.folder.grants() if each.name == name]
        generation = max(int(self._wall_s()), max(used) + 1)
        grants = [each for each in self.folder.grants() if each.name != name]
        grants.append(Grant(f"{name}.{generation}", name, role))
        check_grants(grants, f"--role {role}")
        key = certificates.make_key()
        made = self._sign(certificates.load_key(key).public_key(), name, generation, role, days, hosts)
        self.folder.write(self.folder.key_path(name), key)
        self.folder.write(self.folder.certificate_path(name), made)
        self.folder.write_grants(grants)

    def _renew(
        self, before: Certificate, *, days: float | None = None, hosts: Sequence[str] | None = None
    ) -> Certificate:
        path = self.folder.certificate_path(before.name)
        public = x509.load_pem_x509_certificate(read_pem(path)).public_key()
        assert isinstance(public, ec.EllipticCurvePublicKey)  # noqa: S101  (`Certificate` is of such a key)
        life = before.life_s / DAY_S if days is None else days
        wanted = before.hosts if hosts is None else hosts
        made = self._sign(public, before.name, before.generation, before.role, life, wanted)
        self.folder.write(path, made)
        return certificates.parse_certificate(made)

    def _before(self, name: str) -> Certificate | None:
        """Return the certificate of `name`; None: there is none, or none of this authority that can be read."""
        path = self.folder.certificate_path(name)
        if not path.exists():
            return None
        check_private(path)
        try:
            found = certificates.read_certificate(path)
            own = self._certificate.public_bytes(serialization.Encoding.PEM)
            certificates.check_signed(read_pem(path), own, str(path))
        except ConfigError:
            return None
        return found

    def _valid(self, name: str) -> Certificate:
        before = self._before(name)
        if before is None:
            path = self.folder.certificate_path(name)
            if path.exists():
                what = "this certificate is damaged or of another authority"
                raise ConfigError(what, where=str(path), hint=self.folder.issue_command(name))
            hint = did_you_mean(name, self.folder.names())
            raise ConfigError(f"'{name}' has no certificate", where=str(self.folder.path), hint=hint)
        if not self._is_granted(before):
            hint = self.folder.issue_command(name, before.role)
            raise ConfigError(f"the certificate of '{name}' is revoked", where=str(self.folder.path), hint=hint)
        return before

    def _is_granted(self, certificate: Certificate) -> bool:
        return any(each.common_name == certificate.common_name for each in self.folder.grants())

    def _has_key(self, certificate: Certificate) -> bool:
        """Tell whether the private key of a certificate is here."""
        path = self.folder.key_path(certificate.name)
        if path.exists():
            check_private(path)
        try:
            key = read_pem(path)
            return certificates.parse_request(certificates.make_request(key, "own"))[1] == certificate.public_key
        except ConfigError:
            return False

    def _sign(
        self,
        public: ec.EllipticCurvePublicKey,
        name: str,
        generation: int,
        role: Role,
        days: float,
        hosts: Sequence[str],
    ) -> bytes:
        now_s = self._wall_s()
        life_s = days * DAY_S
        begins = when(now_s - SKEW * life_s)
        if role == "hub":
            # A robot that has no clock of its own starts with the time at which it was switched off.
            begins = self._certificate.not_valid_before_utc
        ends = min(when(now_s + life_s), self._certificate.not_valid_after_utc)
        if ends <= when(now_s):
            raise ConfigError(
                "the swarm's authority has expired",
                where=str(self.folder.authority_path),
                hint="move its folder away, then `fullswarm keys init` and `fullswarm deploy` again",
            )
        subject = x509.Name(
            [
                x509.NameAttribute(NameOID.COMMON_NAME, f"{name}.{generation}"),
                x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role),
                x509.NameAttribute(NameOID.ORGANIZATION_NAME, self.folder.swarm),
            ]
        )
        # Without the use as a server no other process can stand in for the hub.
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if role == "hub" else [])]
        issued = x509.UnrecognizedExtension(certificates.ISSUED_AT, str(int(now_s)).encode("ascii"))
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._certificate.subject)
            .public_key(public)
            .serial_number(x509.random_serial_number())
            .not_valid_before(begins)
            .not_valid_after(ends)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.KeyUsage(True, False, False, False, False, False, False, False, False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
            .add_extension(issued, critical=False)
        )
        if hosts:
            names = x509.SubjectAlternativeName([_alternative(each) for each in hosts])
            builder = builder.add_extension(names, critical=False)
        # Recorded first: a certificate of which the log knows nothing must not come about.
        what: dict[str, object] = {"name": name, "role": role, "generation": generation, "until": ends.isoformat()}
        _record(self.folder, "issued", what)
        return builder.sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def _hub_hosts(hosts: Iterable[str], before: Certificate | None) -> tuple[str, ...]:
    kept = before.hosts if before is not None else (*LOOPBACK, socket.gethostname())
    return tuple(dict.fromkeys(each for each in (*kept, *hosts) if each))


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        return x509.DNSName(host.encode("idna").decode("ascii"))
    except UnicodeError as error:
        raise ConfigError(f"'{host:.80}' is neither an address nor a host name of a hub") from error


def _check_days(days: float, most: float = LONGEST_DAYS) -> None:
    if not 1.0 / DAY_S <= days <= most:
        raise ConfigError(f"a certificate cannot be valid for {days:g} days", where="--days", hint=f"at most {most:g}")


# ---------------------------------------------------------------- without the private key
def revoke(folder: KeysFolder, name: str) -> tuple[Grant, ...]:
    """Revoke the certificate of `name`; the hub drops its holder within a second. Return what was revoked.

    Nothing is returned when it was revoked before.

    Raises
    ------
    ConfigError
        `name` never had a certificate.
    """
    check_name(name)
    with folder.alone():
        grants = folder.grants()
        gone = tuple(each for each in grants if each.name == name)
        if not gone and not folder.certificate_path(name).exists():
            hint = did_you_mean(name, folder.names())
            raise ConfigError(f"'{name}' has no certificate", where=str(folder.path), hint=hint)
        if gone:
            folder.write_grants(each for each in grants if each.name != name)
            # Recorded last: a log that cannot be written must not keep a key valid.
            _record(folder, "revoked", {"name": name, "certificates": [each.common_name for each in gone]})
    return gone


def _record(folder: KeysFolder, result: str, what: dict[str, object]) -> None:
    """Write a change into the audit log of the keys."""
    by = f"uid-{user_id()}@{socket.gethostname()}"
    record(folder.path / AUDIT, f"keys-{os.getpid()}", Event("key", what, result=result, operator=by))


def list_certificates(folder: KeysFolder, now_s: float) -> tuple[Entry, ...]:
    """Return all certificates of a folder, in alphabetical order; `now_s` in seconds since 1970.

    Raises
    ------
    ConfigError
        The list of valid certificates cannot be read.
    """
    valid = {each.common_name for each in folder.grants()}
    return tuple(_entry(folder, name, valid, now_s) for name in folder.names())


def _entry(folder: KeysFolder, name: str, valid: set[str], now_s: float) -> Entry:
    try:
        found = certificates.read_certificate(folder.certificate_path(name))
    except ConfigError as error:
        return Entry(name, None, revoked=False, problem=error.what)
    revoked = found.common_name not in valid
    if revoked:
        problem = "revoked"
    elif found.expires_s <= now_s:
        problem = "expired"
    elif found.begins_s > now_s:
        problem = "not valid yet: is this computer's clock right?"
    else:
        problem = ""
    return Entry(name, found, revoked, problem)


def copy_to(folder: KeysFolder, name: str, out: Path) -> KeysFolder:
    """Copy what the process `name` needs on another computer to the folder `out`, which `FULLSWARM_IDENTITY` names.

    Raises
    ------
    ConfigError
        A file is missing or cannot be written.
    """
    copied = KeysFolder.of(folder.swarm, out)
    for source, target in (
        (folder.authority_path, copied.authority_path),
        (folder.key_path(name), copied.key_path(name)),
        (folder.certificate_path(name), copied.certificate_path(name)),
    ):
        copied.write(target, read_pem(source))
    return copied
