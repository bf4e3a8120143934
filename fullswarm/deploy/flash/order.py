"""What `fullswarm flash` is asked for, the consent to lose what is on a card, and the rows of its result."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fullswarm import output
from fullswarm.deploy.flash import card
from fullswarm.deploy.flash.card import Card
from fullswarm.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Request:
    """What the command line says."""

    robots: tuple[str, ...]
    fleet: Path
    image: Path | None = None
    devices: tuple[str, ...] = ()
    outputs: tuple[Path, ...] = ()
    seed_only: bool = False
    release: str | None = None
    target: str = "rpi-arm64"
    wifi: tuple[str, ...] = ()
    wifi_file: Path | None = None
    country: str | None = None
    static: str | None = None
    sha256: str | None = None
    first_boot: str = "auto"
    agreed: tuple[str, ...] = ()
    most_bytes: int = card.MOST_BYTES
    wait_minutes: float | None = None
    hub: str | None = None
    dry_run: bool = False
    as_json: bool = False


@dataclass(slots=True)
class Line:
    """One row of the result: a robot, its card, and how it went."""

    robot: str
    target: str
    state: str = "planned"
    note: str = ""
    details: dict[str, Any] = field(default_factory=dict)


def agree(
    targets: Sequence[Card | Path],
    agreed: Sequence[str],
    loss: str = "its system stays, the files that tell which robot it is will be lost",
) -> None:
    """Have the user confirm, by its serial number, that each card may lose data.

    Parameters
    ----------
    loss
        What; by default no more than ``--seed-only`` writes over.

    Raises
    ------
    ConfigError
        Not confirmed, or a card is not the same any more.
    """
    cards = [each for each in targets if isinstance(each, Card)]
    for each in card.check_agreed(cards, agreed):
        what = f"{loss}: {each.title}"
        if not sys.stdin.isatty():
            raise ConfigError(what, where=each.path, hint=f"if that is meant: --yes {each.token}")
        output.progress(what)
        sys.stderr.write(f"Type {each.token} to write it: ")
        sys.stderr.flush()
        if sys.stdin.readline().strip() != each.token:
            raise ConfigError("not confirmed; nothing was written", where=each.path, hint=f"type {each.token}")
    for each in cards:
        if not card.same_card(each):
            raise ConfigError("is not the card that it was a moment ago", where=each.path, hint="start again")
