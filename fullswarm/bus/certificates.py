"""Renews certificates without a person: processes ask over the bus, the authority on the base station answers.

A process asks once when it starts, because its clock may be wrong, and again from two thirds of its certificate's life
on. The new certificate has the same name and key, so that only one file changes; the next connection uses it.
"""

from __future__ import annotations

from collections.abc import Callable

from fullswarm.bus.base import Bus
from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.identity.authority import Authority, list_certificates
from fullswarm.identity.certificates import check_signed, make_request, parse_certificate, read_certificate, when
from fullswarm.identity.credentials import Credentials
from fullswarm.identity.folder import KeysFolder
from fullswarm.identity.private import read_pem
from fullswarm.keys import Keys
from fullswarm.logs import Logger
from fullswarm.messages import CertificateReply, CertificateRequest
from fullswarm.runtime import Scheduler, Timer

log = Logger()

SHARE_OF_LIFE = 0.01
"""How often a process looks whether it must ask."""
SHORTEST_S, LONGEST_S = 1.0, 3600.0
LOOK_S = 600.0
"""Longest time until the authority renews what is due in its own folder; also what was restored or issued meanwhile."""
AGAIN_S = 0.5
"""A name is answered this often at most."""
REMEMBERED = 1024


class CertificateRenewer:
    """Asks for a new certificate of this process in time, and puts it in the place of the old one.

    Parameters
    ----------
    bus
        Publishes in the name of this process.
    credentials
        Its files.
    wall_s
        Returns seconds since 1970.
    first_s
        When it asks first, in seconds from now.

    Raises
    ------
    ConfigError
        The certificate or the key cannot be read.
    """

    def __init__(
        self,
        bus: Bus,
        scheduler: Scheduler,
        keys: Keys,
        credentials: Credentials,
        wall_s: Callable[[], float] = wall_time_s,
        *,
        first_s: float = SHORTEST_S,
    ) -> None:
        self._bus, self._keys, self._files, self._wall_s = bus, keys, credentials, wall_s
        self._present = read_certificate(credentials.certificate)
        request = make_request(read_pem(credentials.key), self._present.common_name)
        self._request = CertificateRequest(name=credentials.name, request=request.decode("ascii"))
        self._answered, self._reported = False, ""
        self._folder = KeysFolder(credentials.authority.parent, keys.swarm)
        self._subscription = bus.subscribe(keys.renewal_reply(credentials.name), CertificateReply, self._receive)
        period_s = min(max(SHARE_OF_LIFE * self._present.life_s, SHORTEST_S), LONGEST_S)
        self._timer: Timer = scheduler.every(period_s, self._ask_if_due, first_s=first_s)

    def _ask_if_due(self) -> None:
        now_s = self._wall_s()
        if now_s >= self._present.due_s and self._present.ends_soon(now_s):
            ends = f"{when(self._present.expires_s):%Y-%m-%d %H:%M} UTC"
            hint = f"on the base station: fullswarm keys renew {self._files.name} --swarm {self._keys.swarm}"
            what = "the certificate of this process expires and was not renewed"
            log.warning(what, name=self._files.name, expires=ends, hint=hint)
        if (not self._answered or now_s >= self._present.due_s) and self._bus.connected():
            self._bus.publish(self._keys.renewal_request(self._files.name), self._request)

    def _receive(self, reply: CertificateReply) -> None:
        if reply.name != self._files.name:
            return
        self._answered = True
        if reply.refused:
            self._report(f"the authority does not renew it: {reply.refused}")
            return
        try:
            self._install(reply.certificate.encode())
        except FullswarmError as error:
            self._report(str(error))

    def _install(self, pem: bytes) -> None:
        new = parse_certificate(pem)
        check_signed(pem, read_pem(self._files.authority))
        if (new.common_name, new.public_key) != (self._present.common_name, self._present.public_key):
            raise ConfigError(f"the certificate that arrived is for {new.common_name} or another key")
        if new.expires_s <= self._present.expires_s:
            return  # the one that is here is the newest
        self._folder.write(self._files.certificate, pem)
        self._present, self._reported = new, ""
        log.info("renewed the certificate of this process", name=new.name, expires=f"{when(new.expires_s):%Y-%m-%d}")

    def _report(self, what: str) -> None:
        if what != self._reported:
            self._reported = what
            log.warning("the certificate of this process was not renewed", name=self._files.name, reason=what)

    def close(self) -> None:
        """Stop asking."""
        self._timer.cancel()
        self._subscription.close()


class RenewalService:
    """Answers signing requests with new certificates, and renews those in the authority's own folder.

    Parameters
    ----------
    authority
        It must be able to sign.
    wall_s
        Returns seconds since 1970.
    """

    def __init__(
        self,
        bus: Bus,
        scheduler: Scheduler,
        keys: Keys,
        authority: Authority,
        wall_s: Callable[[], float] = wall_time_s,
    ) -> None:
        self._bus, self._scheduler, self._keys, self._wall_s = bus, scheduler, keys, wall_s
        self._authority = authority
        self._answered_s: dict[str, float] = {}
        self._reported = ""
        self._subscription = bus.subscribe(keys.renewal_request(), CertificateRequest, self._answer)
        self._timer: Timer = scheduler.after(0.0, self._renew_due)

    def _answer(self, request: CertificateRequest) -> None:
        now_s = self._scheduler.now_s()
        if now_s - self._answered_s.get(request.name, -AGAIN_S) < AGAIN_S:
            return
        if len(self._answered_s) >= REMEMBERED:
            self._answered_s.clear()
        self._answered_s[request.name] = now_s
        try:
            pem = self._authority.answer(request.name, request.request.encode())
            reply = CertificateReply(name=request.name, certificate=pem.decode("ascii"))
        except FullswarmError as error:
            log.warning("a certificate was not renewed", name=request.name, reason=str(error))
            reply = CertificateReply(name=request.name, refused=error.what[:256])
        self._bus.publish(self._keys.renewal_reply(request.name), reply)

    def _renew_due(self) -> None:
        next_s = LOOK_S
        try:
            for each in self._authority.renew_due():
                log.info("renewed a certificate", name=each.name, expires=f"{when(each.expires_s):%Y-%m-%d}")
            now_s = self._wall_s()
            entries = list_certificates(self._authority.folder, now_s)
            due = [each.certificate.due_s for each in entries if each.certificate is not None and not each.revoked]
            next_s = min([LOOK_S, *(max(each - now_s, SHORTEST_S) for each in due)])
            self._reported = ""
        except FullswarmError as error:
            if str(error) != self._reported:
                self._reported = str(error)
                log.warning("certificates cannot be renewed", reason=self._reported)
        self._timer = self._scheduler.after(next_s, self._renew_due)

    def close(self) -> None:
        """Stop renewing."""
        self._timer.cancel()
        self._subscription.close()
