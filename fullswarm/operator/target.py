"""Names the swarm and the operator of a command, and tells at once when its hub has not been started.

It imports little: a command that finds no hub should say so before what talks to one is loaded.
"""

from __future__ import annotations

import getpass
import os
import re
import socket
from dataclasses import dataclass

from fullswarm.bus.endpoint import DEFAULT_HUB, no_hub, nothing_listens
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys

REFUSAL_S = 0.3
"""A refusal takes the way to the hub and back; a firewall that answers nothing costs this."""
OPERATOR = "FULLSWARM_OPERATOR"
_NAME = re.compile(r"[^\s,;()]{1,64}\Z")


def operator_name(given: str) -> str:
    """Return the name that an operator chose, if it fits into ``r1 is held by …``.

    Raises
    ------
    ConfigError
        It does not.
    """
    if not _NAME.match(given) or not given.isprintable():
        hint = "64 characters at most, no spaces, commas or brackets, e.g. anna@lab"
        raise ConfigError(f"'{given:.80}' cannot name an operator", where=f"--operator or {OPERATOR}", hint=hint)
    return given


def usual_name() -> str:
    """Return the environment's ``FULLSWARM_OPERATOR``, else ``user@host``; never fails: a stop needs no name."""
    try:
        return operator_name(os.environ[OPERATOR])
    except (KeyError, ConfigError):
        pass
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # an account without a name, as in some containers
        user = "operator"
    return re.sub(r"[^\w.@-]", "-", f"{user}@{socket.gethostname()}")[:64]


@dataclass(frozen=True, slots=True)
class Target:
    """The swarm of a command, and its operator; no `hub` means the one on this machine."""

    hub: str | None = None
    swarm: str = "swarm"
    operator: str = ""  # empty: see `usual_name`


def need_hub(target: Target) -> None:
    """Refuse a hub whose computer says that nothing listens there; for commands that only look.

    Orders wait for the hub instead: they may be given while the swarm still starts.

    Raises
    ------
    Unreachable
        Nothing listens at the hub's address.
    ConfigError
        The hub's address or the swarm's name is malformed.
    """
    Keys(target.swarm)
    hub = target.hub or DEFAULT_HUB
    if nothing_listens(hub, REFUSAL_S):
        raise no_hub(hub)
