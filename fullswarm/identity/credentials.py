"""Defines roles, the files by which a process proves its name to the hub, and the list of valid certificates."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import msgspec

from fullswarm.errors import ConfigError
from fullswarm.keys import ROBOT_ID, TRUTH

Role = Literal["robot", "core", "centralised", "hub", "world", "operator", "console", "observer", "source"]
"""What a process is to the swarm. ``source``: motion capture or a camera; ``observer``: receives, sends nothing."""

ROLES: tuple[Role, ...] = get_args(Role)

FIXED: frozenset[str] = frozenset({"core", "centralised", "hub", "world", "console"})
"""Roles whose only name is the role itself, so that a receiver knows the role of such a sender."""


UNNAMED = "unnamed"
"""The sender's chunk of what a process without a name publishes; no certificate has this name."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """The files by which a process proves its name.

    Parameters
    ----------
    name
        Of the process: a robot's id, ``core``, the name of an operator. The sender's part of each key.
    role
        Its role.
    authority
        Certificate of the fleet's authority, PEM: what it accepts of others must be signed by it.
    certificate, key
        Its own, PEM.
    """

    name: str
    role: Role
    authority: Path
    certificate: Path
    key: Path


class Grant(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One valid certificate: the hub gives its holder the rights of `role` under `name`.

    Parameters
    ----------
    common_name
        The certificate's CN, ``<name>.<generation>``. A certificate whose CN no grant names has no rights: leaving it
        out revokes the certificate.
    name, role
        As in :class:`Credentials`.
    """

    common_name: str
    name: str
    role: Role


def read_grants(path: Path) -> tuple[Grant, ...]:
    """Read the list of valid certificates, a JSON array of objects with the fields of :class:`Grant`.

    Raises
    ------
    ConfigError
        The file is missing or no such list, a name is not a plain chunk of a key or belongs to another role, or a
        common name is there twice.
    """
    try:
        grants = msgspec.json.decode(path.read_bytes(), type=tuple[Grant, ...])
    except OSError as error:
        raise ConfigError(
            f"cannot read the list of valid certificates: {error.strerror}",
            where=str(path),
            hint="`fullswarm keys init` writes it",
        ) from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not a list of valid certificates: {error}", where=str(path)) from error
    check_grants(grants, str(path))
    return grants


def check_grants(grants: Iterable[Grant], where: str) -> None:
    """Refuse a list that would give one certificate or one name two roles, or a name that matches other keys.

    Raises
    ------
    ConfigError
        Names the entry.
    """
    seen: set[str] = set()
    roles: dict[str, Role] = {}
    for grant in grants:
        if not ROBOT_ID.match(grant.name):
            raise ConfigError(
                f"'{grant.name}' cannot name a process",
                where=where,
                hint="use letters, digits, '-' and '_', 64 at most",
            )
        if not grant.common_name or grant.common_name in seen:
            raise ConfigError(f"the common name '{grant.common_name}' is empty or listed twice", where=where)
        fixed = grant.role in FIXED or grant.name in FIXED or grant.name in (UNNAMED, TRUTH)
        if roles.setdefault(grant.name, grant.role) != grant.role or (fixed and grant.name != grant.role):
            raise ConfigError(f"the name '{grant.name}' cannot have the role '{grant.role}'", where=where)
        seen.add(grant.common_name)
