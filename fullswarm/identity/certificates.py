"""Reads names, roles and times from certificates, and makes keys and signing requests; imports ``cryptography``.

The subject of a certificate is ``CN=<name>.<generation>, OU=<role>, O=<swarm>``. A renewed certificate has the same
CN and the same public key. Its time of issue is in an extension of its own, because `not before` may lie earlier.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from fullswarm.errors import ConfigError, MissingExtra

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID
except ModuleNotFoundError as missing:
    raise MissingExtra("certificates need the package cryptography", hint="pip install 'fullswarm[keys]'") from missing

from fullswarm.identity.credentials import ROLES, Role
from fullswarm.identity.private import check_name, read_pem

ISSUED_AT = x509.ObjectIdentifier("2.25.229842604379063917415925180712098157621")
"""Extension with the time of issue, ASCII seconds since 1970; an identifier from a UUID needs no registration."""
DUE = 2.0 / 3.0
"""Share of its life after which a certificate is renewed."""
DAY_S = 86400.0
SOON_S = 7 * DAY_S
"""What expires within this time, or a third of its life, is reported."""
_COMMON_NAME = re.compile(r"(?P<name>[A-Za-z0-9_-]+)\.(?P<generation>[1-9][0-9]{0,9})\Z")


@dataclass(frozen=True, slots=True)
class Certificate:
    """What a certificate states; times in seconds since 1970.

    Parameters
    ----------
    public_key
        SHA-256 of the public key, hexadecimal.
    hosts
        Names and addresses at which clients may reach its holder: those of a hub.
    """

    name: str
    generation: int
    role: Role
    swarm: str
    issued_s: float
    begins_s: float
    expires_s: float
    public_key: str
    hosts: tuple[str, ...] = ()

    @property
    def common_name(self) -> str:
        """Its CN, ``<name>.<generation>``."""
        return f"{self.name}.{self.generation}"

    @property
    def life_s(self) -> float:
        """Seconds from its issue to its end."""
        return self.expires_s - self.issued_s

    @property
    def due_s(self) -> float:
        """When it should be renewed, in seconds since 1970."""
        return self.issued_s + DUE * self.life_s

    def ends_soon(self, now_s: float) -> bool:
        """Tell whether it has expired or will within 7 days, or within a third of its life if that is shorter."""
        return self.expires_s - now_s <= min(SOON_S, (1.0 - DUE) * self.life_s)


# ---------------------------------------------------------------- reading
def read_certificate(path: Path) -> Certificate:
    """Read a certificate from a private PEM file.

    Raises
    ------
    ConfigError
        The file is missing, damaged, readable by others, or another kind of certificate.
    """
    return parse_certificate(read_pem(path), str(path))


def parse_certificate(pem: bytes, where: str = "") -> Certificate:
    """Return what a certificate in PEM states.

    Raises
    ------
    ConfigError
        It is not one that `fullswarm keys` made.
    """
    hint = "`fullswarm keys issue` makes them"
    try:
        parsed = x509.load_pem_x509_certificate(pem)
        names = {each: _only(parsed.subject, each) for each in (_CN, _OU, _O)}
        issued_s = _issued_s(parsed)
        hosts = _hosts(parsed)
        public = _fingerprint(parsed.public_key())
    except (ValueError, UnsupportedAlgorithm, x509.DuplicateExtension) as error:
        raise ConfigError(f"not a certificate of this package: {error}", where=where, hint=hint) from error
    match = _COMMON_NAME.match(names[_CN])
    if match is None or names[_OU] not in ROLES:
        what = f"not a certificate of this package: subject {parsed.subject.rfc4514_string()}"
        raise ConfigError(what, where=where, hint=hint)
    check_name(match["name"])
    return Certificate(
        name=match["name"],
        generation=int(match["generation"]),
        role=cast("Role", names[_OU]),
        swarm=names[_O],
        issued_s=issued_s,
        begins_s=parsed.not_valid_before_utc.timestamp(),
        expires_s=parsed.not_valid_after_utc.timestamp(),
        public_key=public,
        hosts=hosts,
    )


_CN, _OU, _O = NameOID.COMMON_NAME, NameOID.ORGANIZATIONAL_UNIT_NAME, NameOID.ORGANIZATION_NAME


def _only(subject: x509.Name, kind: x509.ObjectIdentifier) -> str:
    found = subject.get_attributes_for_oid(kind)
    if len(found) != 1:
        raise ValueError(f"{len(found)} values of {kind.dotted_string} in its subject")
    return str(found[0].value)


def _issued_s(parsed: x509.Certificate) -> float:
    try:
        value = parsed.extensions.get_extension_for_oid(ISSUED_AT).value
    except x509.ExtensionNotFound:
        return parsed.not_valid_before_utc.timestamp()
    assert isinstance(value, x509.UnrecognizedExtension)  # noqa: S101  (nothing else has this identifier)
    return float(int(value.value.decode("ascii")))


def _hosts(parsed: x509.Certificate) -> tuple[str, ...]:
    try:
        names = parsed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return (*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress)))


def generation_of(common_name: str) -> int:
    """Return the generation in a CN, ``<name>.<generation>``; 0: it has none."""
    match = _COMMON_NAME.match(common_name)
    return 0 if match is None else int(match["generation"])


def check_signed(pem: bytes, authority: bytes, where: str = "") -> None:
    """Refuse a certificate that another authority has signed.

    Raises
    ------
    ConfigError
        It is not signed by `authority`.
    """
    try:
        x509.load_pem_x509_certificate(pem).verify_directly_issued_by(x509.load_pem_x509_certificate(authority))
    except (ValueError, TypeError, InvalidSignature) as error:
        hint = "copy its files from the base station again (`fullswarm keys issue … --out`, or `fullswarm deploy`)"
        raise ConfigError("another authority has signed this certificate", where=where, hint=hint) from error


def _fingerprint(key: object) -> str:
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise ValueError("its key is not on an elliptic curve")
    form = serialization.PublicFormat.SubjectPublicKeyInfo
    return hashlib.sha256(key.public_bytes(serialization.Encoding.DER, form)).hexdigest()


# ---------------------------------------------------------------- keys and requests
def make_key() -> bytes:
    """Return a new private key, PKCS #8 in PEM."""
    return private_pem(ec.generate_private_key(ec.SECP256R1()))


def private_pem(key: ec.EllipticCurvePrivateKey, passphrase: str | None = None) -> bytes:
    """Return a private key as PKCS #8 in PEM, encrypted if there is a passphrase."""
    if passphrase:
        cipher: serialization.KeySerializationEncryption = serialization.BestAvailableEncryption(passphrase.encode())
    else:
        cipher = serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, cipher)


def load_key(pem: bytes, where: str = "", passphrase: str | None = None) -> ec.EllipticCurvePrivateKey:
    """Return the private key in a PEM.

    Raises
    ------
    ConfigError
        It is damaged, of another kind, or needs another passphrase.
    """
    try:
        key = serialization.load_pem_private_key(pem, passphrase.encode() if passphrase else None)
    except TypeError as error:  # encrypted and no passphrase, or the other way round
        needs = "needs a passphrase" if not passphrase else "has no passphrase"
        raise ConfigError(f"this private key {needs}", where=where) from error
    except (ValueError, UnsupportedAlgorithm) as error:
        what = "wrong passphrase, or a damaged private key" if passphrase else "this private key is damaged"
        raise ConfigError(what, where=where) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigError("this private key is of another kind", where=where)
    return key


def make_request(key: bytes, common_name: str) -> bytes:
    """Return a signing request (PKCS #10 in PEM) for a certificate with this CN and the public half of `key`.

    Raises
    ------
    ConfigError
        The key is damaged.
    """
    subject = x509.Name([x509.NameAttribute(_CN, common_name)])
    builder = x509.CertificateSigningRequestBuilder().subject_name(subject)
    return builder.sign(load_key(key), hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def parse_request(pem: bytes) -> tuple[str, str]:
    """Return the CN and the fingerprint of the public key of a signing request whose signature holds.

    Raises
    ------
    ConfigError
        It is damaged, or not signed by the private half of its key.
    """
    try:
        request = x509.load_pem_x509_csr(pem)
        if not request.is_signature_valid:
            raise ValueError("its signature is wrong")
        return _only(request.subject, _CN), _fingerprint(request.public_key())
    except (ValueError, UnsupportedAlgorithm, InvalidSignature) as error:
        raise ConfigError(f"not a signing request: {error}") from error


def when(seconds: float) -> dt.datetime:
    """Return seconds since 1970 as a date with its time zone, UTC; whole seconds."""
    return dt.datetime.fromtimestamp(int(seconds), dt.UTC)
