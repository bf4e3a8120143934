"""Knows whose certificates a fleet needs, issues them all, and checks which are missing or expire soon."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from fullswarm.bringup.checks import Check
from fullswarm.bus.endpoint import host_of, is_secured
from fullswarm.clock import wall_time_s
from fullswarm.config import SwarmConfig
from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.identity import Role
from fullswarm.identity.folder import KeysFolder, certificate_name
from fullswarm.operator.session import usual_name

if TYPE_CHECKING:
    from fullswarm.identity.authority import Authority
    from fullswarm.identity.certificates import Certificate

BASE: tuple[Role, ...] = ("core", "centralised", "hub", "world", "console")
"""Processes of the base station; the name in the certificate of each is its role."""


@dataclass(frozen=True, slots=True)
class Issued:
    """What became of one certificate: ``issued`` now, ``valid`` before, or ``revoked`` and left so."""

    name: str
    role: Role
    state: Literal["issued", "valid", "revoked"]


def names_of(config: SwarmConfig | None) -> tuple[tuple[str, Role], ...]:
    """Return the names and roles of a fleet's processes, and of the present user as operator; None: without robots."""
    base = [(each, each) for each in BASE]
    robots: list[tuple[str, Role]] = [] if config is None else [(each.id, "robot") for each in config.robot]
    return (*base, *robots, (certificate_name(usual_name()), "operator"))


def issue_all(authority: Authority, config: SwarmConfig | None, days: float | None = None) -> Iterator[Issued]:
    """Issue what a fleet lacks, one after the other; a hub gets a certificate for the address in the fleet file.

    What was revoked stays so, until a person issues it.

    Raises
    ------
    ConfigError
        A robot has a name that a certificate cannot have, or that of a process of the base station.
    """
    from fullswarm.identity.authority import list_certificates

    hosts = () if config is None else (host_of(config.hub.endpoint),)
    revoked = {each.name for each in list_certificates(authority.folder, wall_time_s()) if each.revoked}
    for name, role in names_of(config):
        if role == "robot" and (name in BASE or name == certificate_name(usual_name())):
            raise ConfigError(f"a robot cannot be called '{name}': a process or operator is", where="robot.id")
        if name in revoked:
            yield Issued(name, role, "revoked")
            continue
        _, new = authority.issue(name, role, days=days, hosts=hosts if role == "hub" else ())
        yield Issued(name, role, "issued" if new else "valid")


# ---------------------------------------------------------------- checks
def check_certificates(config: SwarmConfig, names: Iterable[tuple[str, Role]] | None = None) -> Iterator[Check]:
    """Check the certificates of a fleet with a secured hub in the keys folder of this computer.

    Parameters
    ----------
    names
        Whose; None: all that the fleet needs, if its authority is here, else this user's own.
    """
    if not is_secured(config.hub.endpoint):
        return
    folder = KeysFolder.of(config.swarm)
    if names is None:
        names = names_of(config) if folder.has_authority else names_of(config)[-1:]
    try:
        from fullswarm.identity import certificates

        valid = {each.common_name for each in folder.grants()} if folder.has_authority else None
    except FullswarmError as error:
        yield Check("certificates", "failure", str(error), error.hint)
        return
    problems, soonest = 0, None
    for name, role in names:
        try:
            folder.credentials(name, role)
            found = certificates.read_certificate(folder.certificate_path(name))
        except ConfigError as error:
            problems += 1
            yield Check(f"certificate {name}", "failure", error.what, error.hint)
            continue
        check = _check(found, valid, wall_time_s())
        soonest = found if soonest is None or found.expires_s < soonest.expires_s else soonest
        if check is not None:
            problems += 1
            yield check
    if not problems and soonest is not None:
        ends = f"{certificates.when(soonest.expires_s):%Y-%m-%d %H:%M} UTC ({soonest.name})"
        yield Check("certificates", "ok", f"all valid; the first one expires {ends}")


def _check(found: Certificate, valid: set[str] | None, now_s: float) -> Check | None:
    from fullswarm.identity.certificates import when

    name, swarm = f"certificate {found.name}", f" --swarm {found.swarm}"
    renew = f"fullswarm keys renew {found.name}{swarm}"
    if found.role == "robot":
        renew += f"; then fullswarm deploy {found.name} --fleet FLEET.toml"
    if valid is not None and found.common_name not in valid:
        return Check(name, "failure", "revoked", KeysFolder.of(found.swarm).issue_command(found.name, found.role))
    if found.expires_s <= now_s:
        return Check(name, "failure", f"expired {when(found.expires_s):%Y-%m-%d %H:%M} UTC", renew)
    if found.begins_s > now_s:
        return Check(name, "failure", f"not valid before {when(found.begins_s):%Y-%m-%d %H:%M} UTC", "set the clock")
    if found.ends_soon(now_s):
        return Check(name, "warning", f"expires {when(found.expires_s):%Y-%m-%d %H:%M} UTC", renew)
    return None


def warnings_of(swarm: str, now_s: float) -> Iterator[str]:
    """Yield a line for each certificate in this computer's keys folder that expires soon, or has expired."""
    folder = KeysFolder.of(swarm)
    if not folder.names():
        return
    from fullswarm.identity.authority import list_certificates
    from fullswarm.identity.certificates import when

    for entry in list_certificates(folder, now_s):
        found = entry.certificate
        if found is not None and not (entry.revoked and folder.has_authority) and found.ends_soon(now_s):
            verb = "expired" if found.expires_s <= now_s else "expires"
            moment = f"{when(found.expires_s):%Y-%m-%d %H:%M} UTC"
            yield f"the certificate of {found.name} {verb} {moment}: fullswarm keys renew {found.name} --swarm {swarm}"
