"""Starts the renewal of certificates in a process; loads what that needs only in a secured swarm."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fullswarm.bus.base import Bus
from fullswarm.errors import FullswarmError
from fullswarm.identity.folder import KeysFolder
from fullswarm.keys import Keys
from fullswarm.logs import Logger
from fullswarm.runtime import Scheduler

if TYPE_CHECKING:
    from fullswarm.bus.certificates import CertificateRenewer, RenewalService
    from fullswarm.identity import Credentials

log = Logger()

AFTER_S = 0.3
"""A command does first what it is for, such as an e-stop."""


def renewal_node(
    bus: Bus, scheduler: Scheduler, keys: Keys, credentials: Credentials, *, first_s: float = 1.0
) -> CertificateRenewer | RenewalService | None:
    """Return what renews the certificate of a secured process; None: nothing here does, which is logged.

    The core of the base station renews for all, if it can sign: not when the authority's key has a passphrase. Other
    processes ask it, unless their files are in the folder that it renews.

    Parameters
    ----------
    first_s
        When a process asks first, in seconds from now.
    """
    folder = KeysFolder(credentials.authority.parent, keys.swarm)
    if folder.has_authority and credentials.role != "core":
        return None
    try:
        from fullswarm.bus.certificates import CertificateRenewer, RenewalService
        from fullswarm.identity.authority import Authority

        if folder.has_authority:
            return RenewalService(bus, scheduler, keys, Authority.open(folder))
        return CertificateRenewer(bus, scheduler, keys, credentials, first_s=first_s)
    except FullswarmError as error:
        log.warning("certificates are not renewed automatically", name=credentials.name, reason=str(error))
    return None


def renew_later(bus: Bus, scheduler: Scheduler, keys: Keys, credentials: Credentials | None) -> None:
    """Renew the certificate of a command or a program while it runs; None: it needs none."""
    if credentials is None:
        return

    def start() -> None:
        renewal_node(bus, scheduler, keys, credentials, first_s=0.0)

    scheduler.after(AFTER_S, start)
