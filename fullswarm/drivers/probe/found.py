"""What was found on a port."""

from __future__ import annotations

from dataclasses import dataclass

from fullswarm.errors import FullswarmError
from fullswarm.reasons import Code


@dataclass(frozen=True, slots=True)
class Found:
    """One robot; empty or None: not known."""

    port: str
    make: str
    model: str
    firmware: str = ""
    battery: float | None = None  # 0 to 1
    url: str = ""  # for the fleet file; empty: there is no driver for it
    note: str = ""  # what it is like now
    advice: str = ""  # what to complete in the URL


@dataclass(frozen=True, slots=True)
class Asked:
    """A port that was asked, and the robots that answered."""

    port: str
    product: str = ""  # its USB description
    robots: tuple[Found, ...] = ()
    problem: str = ""  # why nothing was learned, with what to do
    held: bool = False  # the problem: another process uses the port


def unasked(port: str, error: FullswarmError) -> Asked:
    """Return a port that could not be opened."""
    text = f"{error.what} ({error.hint})" if error.hint else error.what
    return Asked(port, problem=text, held=error.code == Code.PORT_HELD)
