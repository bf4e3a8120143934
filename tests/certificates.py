"""Makes certificates of a fleet for tests: valid, expired, not valid yet, for another name, of another authority."""

from __future__ import annotations

import datetime as dt
import ipaddress
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fullswarm.identity import Credentials, Grant, Role

HOUR = dt.timedelta(hours=1)
LOOPBACK = ("localhost", "127.0.0.1", "::1")


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


class Authority:
    """A fleet's authority with its key in memory; its files are in `folder`."""

    def __init__(self, folder: Path, common_name: str = "test fleet") -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.certificate = folder / "authority.pem"
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _name(common_name)
        now = dt.datetime.now(dt.UTC)
        own = (
            x509.CertificateBuilder()
            .subject_name(self._name)
            .issuer_name(self._name)
            .public_key(self._key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - HOUR)
            .not_valid_after(now + 24 * HOUR)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .sign(self._key, hashes.SHA256())
        )
        self.certificate.write_bytes(own.public_bytes(serialization.Encoding.PEM))

    def issue(
        self,
        name: str,
        role: Role,
        *,
        generation: int = 1,
        hosts: Sequence[str] | None = None,
        starts: dt.timedelta = -HOUR,
        ends: dt.timedelta = 24 * HOUR,
        common_name: str | None = None,
    ) -> Credentials:
        """Make a certificate and its key; valid from `starts` to `ends` after now.

        Parameters
        ----------
        hosts
            Addresses at which it may serve as a hub; None: those of loopback for the role ``hub``, none for others.
        """
        if hosts is None:
            hosts = LOOPBACK if role == "hub" else ()
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH] + ([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])
        key = ec.generate_private_key(ec.SECP256R1())
        now = dt.datetime.now(dt.UTC)
        common_name = f"{name}.{generation}" if common_name is None else common_name
        unsigned = (
            x509.CertificateBuilder()
            .subject_name(_name(common_name))
            .issuer_name(self._name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now + starts)
            .not_valid_after(now + ends)
            .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        )
        if hosts:
            names = x509.SubjectAlternativeName([_alternative(each) for each in hosts])
            unsigned = unsigned.add_extension(names, critical=False)
        issued = unsigned.sign(self._key, hashes.SHA256())
        certificate, private = self.folder / f"{common_name}.pem", self.folder / f"{common_name}.key"
        certificate.write_bytes(issued.public_bytes(serialization.Encoding.PEM))
        private.write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        private.chmod(0o600)
        return Credentials(name, role, self.certificate, certificate, private)


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def grant_of(credentials: Credentials, generation: int = 1) -> Grant:
    """Return the grant that makes a certificate of `credentials` valid."""
    return Grant(f"{credentials.name}.{generation}", credentials.name, credentials.role)
