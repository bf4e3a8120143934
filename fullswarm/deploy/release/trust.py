"""Defines what robots trust: root metadata, and the signed statements about releases and support packages.

The rules are those of The Update Framework (TUF). *Root metadata* list the keys that sign releases and the root keys
that sign root metadata. A robot accepts root metadata only as the next version, signed by a threshold of the root keys
that it trusts already and by a threshold of those that the new version lists. A *statement* about a release or about
support packages has a number that grows, a time at which it expires, and hashes of all parts; a robot refuses an older
number, an expired statement, and parts of another release. A document is its text followed by its signatures, in one
file, so that it is replaced in one step; ``fullswarm-robot`` reads it with a POSIX shell (``robot/robot-trust.sh``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from fullswarm.deploy.release.signatures import (
    IDENTITY,
    ROOT_NAMESPACE,
    STATEMENT_NAMESPACE,
    SUMS_NAMESPACE,
    SUPPORT_NAMESPACE,
    split,
    verify,
)
from fullswarm.errors import ConfigError

DAY_S = 86_400
ROOT_LIFE_S, KEY_LIFE_S = 5 * 365 * DAY_S, 2 * 365 * DAY_S
RELEASE_LIFE_S, SUPPORT_LIFE_S = 365 * DAY_S, 7 * DAY_S
"""Time until a statement expires, seconds. A card may wait for months; a support package is installed at once."""
_KEY = r"[a-z0-9@.-]+ [A-Za-z0-9+/=]+"
_ROOT = re.compile(
    r"fullswarm-root 1\nversion (\d{1,9})\nexpires (\d{1,12})\nthreshold (\d{1,2})\n"
    rf"((?:root {_KEY}\n)+)((?:release \d{{1,12}} {_KEY}\n)+)"
)
_STATEMENT = re.compile(
    r"fullswarm-release 1\nid (\S+)\nnumber (\d{1,12})\nexpires (\d{1,12})\nsums ([0-9a-f]{64})\n(older yes\n)?"
)


@dataclass(frozen=True, slots=True)
class ReleaseKey:
    """A key that signs releases and support packages; `key` as ``ssh-ed25519 AAAA…``, `until_s` since 1970."""

    key: str
    until_s: int


@dataclass(frozen=True, slots=True)
class Root:
    """One version of the root metadata; times in seconds since 1970."""

    version: int
    expires_s: int
    threshold: int
    roots: tuple[str, ...]
    releases: tuple[ReleaseKey, ...]

    @classmethod
    def parse(cls, document: str, where: str = "root metadata") -> Root:
        """Read a document, without verifying its signatures.

        Raises
        ------
        ConfigError
            It is damaged, lists a root key twice, or has fewer root keys than its threshold.
        """
        found = _ROOT.fullmatch(split(document)[0])
        if found is None:
            raise ConfigError("these are not root metadata", where=where, hint="restore the folder from its backup")
        version, expires_s, threshold = (int(found[each]) for each in (1, 2, 3))
        roots = tuple(line.removeprefix("root ") for line in found[4].splitlines())
        releases = (line.split(maxsplit=2) for line in found[5].splitlines())
        root = cls(
            version, expires_s, threshold, roots, tuple(ReleaseKey(key, int(until)) for _, until, key in releases)
        )
        root.check(where)
        return root

    def check(self, where: str = "root metadata") -> None:
        """Check that no root key is listed twice, and that the threshold can be met.

        Raises
        ------
        ConfigError
            Otherwise.
        """
        if len(set(self.roots)) < len(self.roots) or not 1 <= self.threshold <= len(self.roots):
            what = f"a threshold of {self.threshold} needs as many different root keys, and here are {len(self.roots)}"
            raise ConfigError(what, where=where, hint="--threshold N, or --add FILE")
        if not self.releases:
            raise ConfigError("no key would sign releases", where=where, hint="`fullswarm signing rotate`")

    @property
    def text(self) -> str:
        """What is signed."""
        lines = ["fullswarm-root 1", f"version {self.version}", f"expires {self.expires_s}"]
        lines += [f"threshold {self.threshold}", *(f"root {each}" for each in self.roots)]
        lines += [f"release {each.until_s} {each.key}" for each in self.releases]
        return "".join(f"{line}\n" for line in lines)

    def allowed_signers(self, now_s: float) -> str:
        """Return the release keys that have not expired as OpenSSH's ``allowed_signers``."""
        kinds = f"{SUMS_NAMESPACE},{STATEMENT_NAMESPACE},{SUPPORT_NAMESPACE}"
        valid = (each.key for each in self.releases if each.until_s > now_s)
        return "".join(f'{IDENTITY} namespaces="{kinds}" {each}\n' for each in valid)

    def signers_of(self, document: str) -> tuple[str, ...]:
        """Return those of our root keys that have signed a document."""
        text, signatures = split(document)
        return tuple(each for each in self.roots if any(_signed(text, made, each) for made in signatures))


def _signed(text: str, signature: str, key: str) -> bool:
    try:
        verify(text.encode(), signature, ROOT_NAMESPACE, f'{IDENTITY} namespaces="{ROOT_NAMESPACE}" {key}\n')
    except ConfigError:
        return False
    return True


def check_successor(before: Root, document: str) -> Root:
    """Return the root metadata of a document, which must be the next version, signed as robots demand it.

    Raises
    ------
    ConfigError
        Another version, or too few signatures.
    """
    after = Root.parse(document)
    if after.version != before.version + 1:
        raise ConfigError(f"version {after.version} does not follow version {before.version}", where="root metadata")
    for each in (before, after):
        if (made := len(each.signers_of(document))) < each.threshold:
            what = f"signed by {made} of the {each.threshold} root keys that version {each.version} needs"
            raise ConfigError(what, where="root metadata", hint="--root-key FILE names a key on another medium")
    return after


@dataclass(frozen=True, slots=True)
class Statement:
    """What is signed about a release; `sums` is the SHA-256 of its ``SHA256SUMS``."""

    release: str
    number: int
    expires_s: int
    sums: str
    older: bool = False

    @classmethod
    def parse(cls, document: str, where: str) -> Statement:
        """Read a document, without verifying its signature.

        Raises
        ------
        ConfigError
            It is damaged.
        """
        found = _STATEMENT.fullmatch(split(document)[0])
        if found is None:
            raise ConfigError("this is not the statement about a release", where=where, hint="bundle again")
        return cls(found[1], int(found[2]), int(found[3]), found[4], found[5] is not None)

    @property
    def text(self) -> str:
        """What is signed."""
        older = "older yes\n" if self.older else ""
        return (
            f"fullswarm-release 1\nid {self.release}\nnumber {self.number}\nexpires {self.expires_s}\n"
            f"sums {self.sums}\n{older}"
        )


def support_text(number: int, expires_s: int, packages: Mapping[str, tuple[str, str]], *, rename: bool) -> str:
    """Return what is signed about support packages.

    Parameters
    ----------
    packages
        By robot: SHA-256 of its ``install.sh`` and of its ``kit.sums``.
    rename
        A robot of another name accepts its package.
    """
    lines = ["fullswarm-support 1", f"number {number}", f"expires {expires_s}", *(["rename yes"] if rename else [])]
    lines += [f"package {robot} {install} {sums}" for robot, (install, sums) in sorted(packages.items())]
    return "".join(f"{line}\n" for line in lines)


def day_of(when_s: float) -> str:
    """Return the day of a time, in UTC."""
    return f"{datetime.fromtimestamp(when_s, UTC):%Y-%m-%d}"
