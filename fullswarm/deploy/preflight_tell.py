"""How preflight puts times into words."""

from __future__ import annotations


def took(seconds: float) -> str:
    """Return a time as people say it: ``3.4 ms``, ``1.25 s``."""
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"
