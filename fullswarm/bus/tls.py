"""Makes zenoh's settings of a secured link, and finds out why a hub and a client do not connect.

Zenoh says only that it cannot connect, so the cause is looked for with the standard library: first in the own files, by
a handshake in memory, then by a handshake with the hub.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import os
import socket
import ssl

from fullswarm.bus.endpoint import host_of
from fullswarm.errors import ConfigError, FullswarmError, Unreachable
from fullswarm.identity import Credentials

PROBE_S = 1.0
"""Longest wait for each step of a handshake with the hub."""
REFUSAL_S = 0.3
"""The hub refuses a client's certificate after the client has finished its own side of the handshake."""

_NOT_YET_VALID, _EXPIRED, _HOST_MISMATCH, _ADDRESS_MISMATCH = 9, 10, 62, 64  # X509_V_ERR_… of OpenSSL
_FOREIGN = frozenset({2, 7, 18, 19, 20, 21})  # of another authority
_RENEW = "renew it with `fullswarm keys renew`"


def link_settings(credentials: Credentials, *, listens: bool) -> dict[str, object]:
    """Return the settings of :func:`~fullswarm.bus.zenoh_bus.config` for a link that proves its name.

    Raises
    ------
    ConfigError
        A file is missing or unreadable, or the certificate and the key do not belong together.
    """
    check_files(credentials)
    side = "listen" if listens else "connect"
    settings = {
        "root_ca_certificate": str(credentials.authority),
        f"{side}_certificate": str(credentials.certificate),
        f"{side}_private_key": str(credentials.key),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    return {f"transport__link__tls__{name}": value for name, value in settings.items()}


def check_files(credentials: Credentials) -> None:
    """Refuse credentials that can never work, whatever the time is.

    Raises
    ------
    ConfigError
        A file is missing or unreadable, or the certificate and the key do not belong together.
    """
    for path, what in (
        (credentials.authority, "the certificate of the authority"),
        (credentials.certificate, "the certificate"),
        (credentials.key, "the private key"),
    ):
        if not os.access(path, os.R_OK):
            problem = "cannot be read" if path.exists() else "is missing"
            raise ConfigError(
                f"{what} of '{credentials.name}' {problem}",
                where=str(path),
                hint=f"issue it with `fullswarm keys issue {credentials.name} --role {credentials.role}`, and copy the "
                "files to this computer",
            )
    try:
        _context(credentials, ssl.PROTOCOL_TLS_CLIENT)
    except (ssl.SSLError, OSError) as error:
        raise ConfigError(
            f"the certificate and the private key of '{credentials.name}' cannot be used: {_text(error)}",
            where=str(credentials.certificate),
            hint=f"issue them again with `fullswarm keys issue {credentials.name} --role {credentials.role}`",
        ) from error


def problem_of_own(credentials: Credentials) -> str:
    """Return what is wrong with a certificate today: expired, not valid yet, of another authority; empty: nothing."""
    # One side has the certificate and verifies nothing, the other verifies it for what it is used for.
    listens = credentials.role == "hub"
    server, client = (_context(credentials, each) for each in (ssl.PROTOCOL_TLS_SERVER, ssl.PROTOCOL_TLS_CLIENT))
    client.check_hostname = False
    client.verify_mode = ssl.CERT_REQUIRED if listens else ssl.CERT_NONE
    server.verify_mode = ssl.CERT_NONE if listens else ssl.CERT_REQUIRED
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    asks, answers = client.wrap_bio(to_client, to_server), server.wrap_bio(to_server, to_client, server_side=True)
    try:
        for side in (asks, answers, asks, answers):
            with contextlib.suppress(ssl.SSLWantReadError):
                side.do_handshake()
    except ssl.SSLCertVerificationError as error:
        return _own(credentials, error.verify_code)
    return ""


def _own(credentials: Credentials, code: int) -> str:
    name, now = f"the certificate of '{credentials.name}'", f"{dt.datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"
    if code == _EXPIRED:
        return f"{name} or of its authority has expired (this computer's clock: {now}); {_RENEW}"
    if code == _NOT_YET_VALID:
        return f"{name} is not valid yet (this computer's clock: {now}); set the clock"
    if code in _FOREIGN:
        return f"{name} is not of the authority in {credentials.authority}; issue it with that authority's folder"
    return f"{name} is refused (OpenSSL's reason {code})"


def explain(endpoint: str, credentials: Credentials | None) -> FullswarmError | None:
    """Return why the hub at `endpoint` and this process do not connect, as far as it shows; None: nothing shows.

    Takes up to three times `PROBE_S`.
    """
    if credentials is not None:
        problem = problem_of_own(credentials)
        if problem:
            return Unreachable(problem, where=str(credentials.certificate))
    host, port = host_of(endpoint), int(endpoint.rpartition(":")[2])
    try:
        with socket.create_connection((host, port), PROBE_S) as link:
            return _explain_link(link, host, endpoint, credentials)
    except OSError:
        return None


def _explain_link(
    link: socket.socket, host: str, endpoint: str, credentials: Credentials | None
) -> FullswarmError | None:
    if credentials is None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    else:
        context = _context(credentials, ssl.PROTOCOL_TLS_CLIENT)
    handshaken = False
    try:
        with context.wrap_socket(link, server_hostname=host) as secured:
            if credentials is None:
                return _speaks_tls(endpoint)
            handshaken = True
            secured.settimeout(REFUSAL_S)
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return Unreachable(_hubs(error.verify_code, host, error), where=endpoint)
    except ssl.SSLError as error:
        if credentials is None:
            return _speaks_tls(endpoint) if "ALERT" in str(error.reason) else None
        if error.reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE"):
            return _speaks_no_tls(endpoint)
        return Unreachable(
            f"the hub refuses the certificate of '{credentials.name}': {_text(error)}",
            where=endpoint,
            hint="are both of one authority, and is the clock of each computer right?",
        )
    except TimeoutError:
        return _speaks_no_tls(endpoint) if credentials is not None and not handshaken else None
    except OSError:
        return _speaks_no_tls(endpoint) if credentials is not None else None
    return None


def _speaks_no_tls(endpoint: str) -> FullswarmError:
    return Unreachable(
        "what listens there does not answer as a secured hub",
        where=endpoint,
        hint="is its endpoint tcp/…, or is the hub frozen?",
    )


def _speaks_tls(endpoint: str) -> FullswarmError:
    return Unreachable("this hub is secured", where=endpoint, hint=f"its endpoint is tls/{endpoint.partition('/')[2]}")


def _hubs(code: int, host: str, error: ssl.SSLCertVerificationError) -> str:
    if code == _EXPIRED:
        return f"the hub's certificate has expired; {_RENEW} on the hub's computer"
    if code == _NOT_YET_VALID:
        now = f"{dt.datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"
        return f"the hub's certificate is not valid yet; is the clock right? (this computer's: {now})"
    if code in (_HOST_MISMATCH, _ADDRESS_MISMATCH):
        return f"the hub's certificate is not for '{host}'; issue it for this address, or connect to one that it names"
    if code in _FOREIGN:
        return "the hub's certificate is of another authority: is this the hub of another swarm?"
    return f"the hub's certificate is refused: {error.verify_message}"


def not_in_list(credentials: Credentials, endpoint: str) -> FullswarmError:
    """Return the error for a hub that has linked to this process, and does not admit it."""
    return Unreachable(
        f"the hub's list of valid certificates does not have that of '{credentials.name}'",
        where=endpoint,
        hint="it was revoked, or never granted there: `fullswarm keys list` on the hub's computer shows it, `fullswarm "
        f"keys issue {credentials.name} --role {credentials.role}` makes a new one",
    )


def _context(credentials: Credentials, protocol: int) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.load_verify_locations(credentials.authority)
    context.load_cert_chain(credentials.certificate, credentials.key, password=_no_password)
    return context


def _no_password() -> str:
    """Keep OpenSSL from asking at the terminal."""
    return ""


def _text(error: ssl.SSLError | OSError) -> str:
    reason = getattr(error, "reason", None)
    return reason.lower().replace("_", " ") if isinstance(reason, str) and reason else str(error)
