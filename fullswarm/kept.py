"""What operators keep under a name in the core's database: places on the map, and requests to be made again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from fullswarm.errors import ConfigError
from fullswarm.keys import ROBOT_ID
from fullswarm.messages import Metres, Names, Needs, Parameters, Roles, ShortText, TeamName

PLACE, SAVED = "place/", "saved/"
"""Keys of the core's database begin so; the name follows."""
MOST_KEPT = 64
"""Places of all operators, and as many saved requests."""


class Place(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A place on the map; world frame, metres. An area has two opposite corners, or all of its corners in order."""

    kind: Literal["point", "area"]
    points: Annotated[tuple[tuple[Metres, Metres], ...], Meta(min_length=1, max_length=64)]


class SavedRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A request as it was asked; no robots: whichever are selected then."""

    behaviour: Annotated[ShortText, Meta(min_length=1)]
    parameters: Parameters = {}
    robots: Names = ()
    team: TeamName = ""
    needs: Needs = Needs()
    roles: Roles = {}


def check_place(key: str, value: object) -> dict[str, Any] | None:
    """Return a place fit to be stored under ``place/<name>``; None takes it away.

    Raises
    ------
    ConfigError
        The name cannot be one, or the value is no place.
    """
    place = _checked(key, PLACE, value, Place)
    if place is None:
        return None
    count = len(place["points"])
    if place["kind"] == "point" and count != 1:
        raise ConfigError(f"{key}: {count} points for one place", hint="give one, or make it an area")
    if place["kind"] == "area" and count < 2:
        raise ConfigError(f"{key}: an area has two opposite corners, or all of its corners", hint="give more points")
    return place


def check_saved(key: str, value: object) -> dict[str, Any] | None:
    """Return a request fit to be stored under ``saved/<name>``; None takes it away.

    Whether there is such a behaviour, and what its parameters may be, is asked when it is requested.

    Raises
    ------
    ConfigError
        The name cannot be one, or the value is no request.
    """
    return _checked(key, SAVED, value, SavedRequest)


CHECKS: dict[str, Callable[[str, object], dict[str, Any] | None]] = {PLACE: check_place, SAVED: check_saved}
"""By the beginning of a key: what may be stored there."""


def _checked(key: str, prefix: str, value: object, kind: type[msgspec.Struct]) -> dict[str, Any] | None:
    name = key.removeprefix(prefix)
    if not ROBOT_ID.match(name):
        raise ConfigError(
            f"'{name:.80}' cannot be a name", where=prefix, hint="letters, digits, '-' and '_', 64 at most"
        )
    if value is None:
        return None
    try:
        found: dict[str, Any] = msgspec.to_builtins(msgspec.convert(value, kind, strict=True))
    except msgspec.ValidationError as error:
        what, _, where = str(error).partition(" - at `$.")
        raise ConfigError(f"{where.rstrip('`')}: {what}" if where else what, where=key) from None
    stored: dict[str, Any] = _lists(found)
    return stored


def _lists(value: Any) -> Any:
    """Return the same with lists for tuples: what is stored compares equal to what is read back."""
    if isinstance(value, dict):
        return {name: _lists(each) for name, each in value.items()}
    return [_lists(each) for each in value] if isinstance(value, list | tuple) else value
