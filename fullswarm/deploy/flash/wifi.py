"""Wi-Fi networks for a card: from a file, the environment or a prompt, never from the command line's words.

The card carries a network's derived key (PBKDF2, as every access point computes it), not the passphrase.
"""

from __future__ import annotations

import hashlib
import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fullswarm.errors import ConfigError

PASSPHRASE = "FULLSWARM_WIFI_PASSPHRASE"  # noqa: S105  (its name)
"""Environment variable with the passphrase of networks given by --wifi."""

_KEY = re.compile(r"[0-9a-fA-F]{64}\Z")
_ISO = (
    "AD AE AF AG AI AL AM AO AQ AR AS AT AU AW AX AZ BA BB BD BE BF BG BH BI BJ BL BM BN BO BQ BR BS BT BV BW BY BZ "
    "CA CC CD CF CG CH CI CK CL CM CN CO CR CU CV CW CX CY CZ DE DJ DK DM DO DZ EC EE EG EH ER ES ET FI FJ FK FM FO "
    "FR GA GB GD GE GF GG GH GI GL GM GN GP GQ GR GS GT GU GW GY HK HM HN HR HT HU ID IE IL IM IN IO IQ IR IS IT JE "
    "JM JO JP KE KG KH KI KM KN KP KR KW KY KZ LA LB LC LI LK LR LS LT LU LV LY MA MC MD ME MF MG MH MK ML MM MN MO "
    "MP MQ MR MS MT MU MV MW MX MY MZ NA NC NE NF NG NI NL NO NP NR NU NZ OM PA PE PF PG PH PK PL PM PN PR PS PT PW "
    "PY QA RE RO RS RU RW SA SB SC SD SE SG SH SI SJ SK SL SM SN SO SR SS ST SV SX SY SZ TC TD TF TG TH TJ TK TL TM "
    "TN TO TR TT TV TW TZ UA UG UM US UY UZ VA VC VE VG VI VN VU WF WS YE YT ZA ZM ZW"
)
COUNTRIES = frozenset(_ISO.split())
"""ISO 3166-1: the valid regulatory domains."""


@dataclass(frozen=True, slots=True)
class Network:
    """One Wi-Fi network; `key` is 64 hexadecimal digits, empty for an open one."""

    ssid: str
    key: str = ""
    hidden: bool = False

    def __repr__(self) -> str:
        """Keep the key out of logs and tracebacks."""
        return f"Network({self.ssid!r}, key={'yes' if self.key else 'no'}, hidden={self.hidden})"


def check_country(text: str | None, *, wireless: bool) -> str:
    """Return the regulatory domain, upper case; empty when there is none and no Wi-Fi needs it.

    Raises
    ------
    ConfigError
        It is missing although there is Wi-Fi, or is not a country's code.
    """
    if not text:
        if not wireless:
            return ""
        what = "Wi-Fi needs the country where the robot is used: without it the radio stays off"
        raise ConfigError(what, where="--country", hint="two letters, e.g. --country DE")
    country = text.strip().upper()
    if country not in COUNTRIES:
        hint = "the United Kingdom is GB" if country == "UK" else "two letters of ISO 3166, e.g. DE, US, JP"
        raise ConfigError(f"'{text:.20}' is not a country", where="--country", hint=hint)
    return country


def network(ssid: str, passphrase: str, *, hidden: bool = False, where: str = "--wifi") -> Network:
    """Return a network whose passphrase has become its key; an empty one: it is open.

    Raises
    ------
    ConfigError
        The name or the passphrase is invalid.
    """
    raw = ssid.encode("utf-8", "surrogatepass")
    if not 1 <= len(raw) <= 32 or not ssid.isprintable():
        what = f"'{ssid:.40}' is not a valid Wi-Fi network name"
        raise ConfigError(what, where=where, hint="1 to 32 bytes, no control characters")
    if not passphrase:
        return Network(ssid, "", hidden)
    if _KEY.match(passphrase):
        return Network(ssid, passphrase.lower(), hidden)
    if not (8 <= len(passphrase) <= 63 and passphrase.isascii() and passphrase.isprintable()):
        what = f"the passphrase of '{ssid}' is invalid: {len(passphrase)} characters"
        raise ConfigError(what, where=where, hint="8 to 63 ASCII characters, or the 64 hexadecimal digits of its key")
    key = hashlib.pbkdf2_hmac("sha1", passphrase.encode("ascii"), raw, 4096, 32).hex()
    return Network(ssid, key, hidden)


def read_file(path: Path) -> tuple[tuple[Network, ...], str]:
    """Return the networks of a file and its country, empty when it names none.

    ::

        country = "DE"
        [[network]]
        ssid = "lab"
        passphrase = "…"       # or key = "64 hexadecimal digits"; neither: an open network
        hidden = false

    Raises
    ------
    ConfigError
        It cannot be read, others may read it, or its content is invalid.
    """
    example = 'write [[network]] ssid = "lab" passphrase = "…", one per network'
    try:
        if path.stat().st_mode & 0o077:
            raise ConfigError("others may read the passphrases in it", where=str(path), hint=f"chmod 600 {path}")
        document = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path), hint=example) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not valid TOML: {error}", where=str(path), hint=example) from None
    if unknown := set(document) - {"country", "network"}:
        raise ConfigError(f"unknown: {', '.join(sorted(unknown))}", where=str(path), hint=example)
    entries = document.get("network", [])
    if not isinstance(entries, list) or not entries:
        raise ConfigError("has no [[network]]", where=str(path), hint=example)
    return tuple(_entry(each, path, example) for each in entries), str(document.get("country", ""))


def _entry(entry: object, path: Path, example: str) -> Network:
    if not isinstance(entry, dict) or not isinstance(entry.get("ssid"), str):
        raise ConfigError("a network without an ssid", where=str(path), hint=example)
    if unknown := set(entry) - {"ssid", "passphrase", "key", "hidden"}:
        what = f"network '{entry['ssid']}': unknown: {', '.join(sorted(unknown))}"
        raise ConfigError(what, where=str(path), hint=example)
    secret = entry.get("passphrase", entry.get("key", ""))
    return network(entry["ssid"], str(secret), hidden=entry.get("hidden") is True, where=str(path))


def gather(
    file: Path | None,
    ssids: Sequence[str],
    country: str | None,
    ask: Callable[[str], str],
    environment: Mapping[str, str] = os.environ,
) -> tuple[tuple[Network, ...], str]:
    """Return all networks and the country; `ask` returns the passphrase of a network that is in no file.

    Raises
    ------
    ConfigError
        Something about them is wrong, or the country is missing.
    """
    networks, from_file = read_file(file) if file is not None else ((), "")
    for ssid in ssids:
        known = environment.get(PASSPHRASE)
        networks += (network(ssid, ask(ssid) if known is None else known),)
    twice = {each.ssid for each in networks if [other.ssid for other in networks].count(each.ssid) > 1}
    if twice:
        raise ConfigError(f"'{min(twice)}' is given twice", where="--wifi", hint="name it once")
    return networks, check_country(country or from_file, wireless=bool(networks))
