"""What the shell offers on TAB: robots, groups, behaviours, parameters, scenarios, experiments.

From the live swarm if its hub answers at once, else from the fleet file, else what comes with the package. Nothing
here may complain, wait or import much: it runs at each press of a key.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import typer

from fullswarm.operator.known import Known, from_fleet, from_package, from_swarm

Offer = list[tuple[str, str]]
"""Words with their explanation, which zsh and fish show."""

SWITCH = "_FULLSWARM_COMPLETE"
"""By which the shell's script asks; its value names the shell."""
PACKAGE = Path(__file__).parents[1]
EXAMPLES = {"point": "1.0,2.0", "points": "[[0,0],[1,1]]", "number": "1.0", "integer": "1", "word": "word"}


# ---------------------------------------------------------------- what the options call
def robots(context: typer.Context, incomplete: str) -> Offer:
    """Offer ids and @groups for the last word of ``r1,r2,…``."""
    known = _known(context, live=True, robots=True)
    offer = [(robot, "") for robot in known.robots]
    offer += [(f"@{name}", ", ".join(members)) for name, members in known.groups.items()]
    return _listed(offer, incomplete)


def robot_ids(context: typer.Context, incomplete: str) -> Offer:
    """Offer ids alone: what goes straight to the robots knows no groups."""
    return _listed([(robot, "") for robot in _known(context, live=True, robots=True).robots], incomplete)


def fleet_robots(context: typer.Context, incomplete: str) -> Offer:
    """Offer the ids that the fleet file on the line names."""
    return _listed([(robot, "") for robot in _known(context, live=False).robots], incomplete)


def emulated_makes(incomplete: str) -> Offer:
    """Offer the makes that can be emulated."""
    from fullswarm.drivers.make import makes

    return _listed([(each.name, each.robots) for each in makes() if each.emulation], incomplete)


def behaviours(context: typer.Context, incomplete: str) -> Offer:
    """Offer what can be asked for."""
    records = _known(context, live=True).behaviours
    return _begun([(name, str(record.get("summary", ""))) for name, record in records.items()], incomplete)


def parameters(context: typer.Context, incomplete: str) -> Offer:
    """Offer ``key=`` of the behaviour on the line, and after the equals sign the values worth trying."""
    # An option that still lacks its value keeps the parser from handing out the words before it.
    named = context.params.get("behaviour") or next(iter(context.args), None)
    record = _known(context, live=True).behaviours.get(str(named), {})
    offer: Offer = []
    for key, spec in (record.get("parameters") or {}).items():
        if isinstance(spec, dict) and not _given(context, key):
            unit = f" ({spec['unit']})" if spec.get("unit") else ""
            # Never `key=` alone: a shell ends a word that is the only one with a space.
            offer += [(f"{key}={value}", f"{spec.get('doc', '')}{unit}") for value in ("", *_values(spec))]
    return [each for each in _begun(offer, incomplete) if each[0] != incomplete]


def database_keys(context: typer.Context, incomplete: str) -> Offer:
    """Offer the keys of the core's database."""
    return _begun([(key, "") for key in _known(context, live=True).keys], incomplete)


def layers(incomplete: str) -> Offer:
    """Offer who has a database that can be asked."""
    return _begun([("core", "the base station's main controller and request handler")], incomplete)


def scenarios(incomplete: str) -> Offer:
    """Offer the scenarios of the package."""
    return _begun(_files("evaluate/scenarios"), incomplete)


def experiments(incomplete: str) -> Offer:
    """Offer the experiments of the package."""
    return _begun(_files("evaluate/experiment"), incomplete)


def settings(incomplete: str) -> Offer:
    """Offer the keys of a fleet file, for ``--set agent.sensing_radius_m=5``."""
    from fullswarm.config import SwarmConfig

    offer: Offer = []
    for section, field in SwarmConfig.model_fields.items():
        fields = getattr(field.annotation, "model_fields", None)
        if section == "world":
            fields = type(SwarmConfig().world_or_default).model_fields
        offer += [(f"{section}.{key}={_plain(each.default)}", "") for key, each in (fields or {}).items()]
    offer += [(word.partition("=")[0] + "=", text) for word, text in offer]
    return [each for each in _begun(sorted(offer), incomplete) if each[0] != incomplete]


# ---------------------------------------------------------------- where it comes from
def _known(context: typer.Context, *, live: bool, robots: bool = False) -> Known:
    given = context.params
    hub, swarm = given.get("hub"), given.get("swarm") or "swarm"
    named = given.get("fleet") or os.environ.get("FULLSWARM_FLEET")
    if live:
        seen = from_swarm(hub or os.environ.get("FULLSWARM_HUB"), str(swarm), robots=robots)
        if seen is not None:
            return seen
    known = from_package()
    if named:
        with contextlib.suppress(Exception):  # half a path, or a file that is being written
            return from_fleet(Path(str(named)), known)
    return known


def _files(folder: str) -> Offer:
    offer: Offer = []
    for file in sorted((PACKAGE / folder).glob("*.toml")):
        text = tomllib.loads(file.read_text("utf-8"))
        offer.append((file.stem, str(text.get("summary") or text.get("title") or "")))
    return offer


def _given(context: typer.Context, key: str) -> bool:
    return any(str(each).startswith(f"{key}=") for each in context.params.get("settings") or ())


def _values(spec: Mapping[str, Any]) -> Iterable[str]:
    if spec.get("choices"):
        return [str(each) for each in spec["choices"]]
    if spec.get("type") == "flag":
        return ["true", "false"]
    default = spec.get("default")
    return [EXAMPLES.get(str(spec.get("type")), "1.0") if default is None else _plain(default)]


def _plain(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return ",".join(map(_plain, value))
    return str(value) if isinstance(value, int | float | str) else ""


# ---------------------------------------------------------------- words
def _begun(offer: Offer, incomplete: str) -> Offer:
    return [each for each in offer if each[0].startswith(incomplete)]


def _listed(offer: Offer, incomplete: str) -> Offer:
    before, comma, _ = incomplete.rpartition(",")
    taken = set(before.split(","))
    return _begun([(f"{before}{comma}{word}", text) for word, text in offer if word not in taken], incomplete)


# ---------------------------------------------------------------- talking to the shell
def answer(program: Callable[[], object]) -> int:
    """Run the program as the shell's script asked, and print nothing but the words it may offer.

    Bash takes ``=``, ``@`` and ``:`` for ends of words: what it has torn apart is put together for the program, and
    what it keeps of the word is taken off the answer.
    """
    kept, instruction = "", os.environ.get(SWITCH, "")
    if instruction == "complete_bash":
        words, at, kept = mended(os.environ.get("COMP_WORDS", "").split("\n"), os.environ.get("COMP_CWORD", "0"))
        os.environ["COMP_WORDS"], os.environ["COMP_CWORD"] = _quoted(words), str(at)
    out = io.StringIO()
    with contextlib.suppress(BaseException), contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        program()
    lines = out.getvalue().splitlines()
    if kept:
        lines = [line.removeprefix(kept) for line in lines]
    if lines:
        sys.stdout.write("\n".join(lines) + "\n")
        sys.stdout.flush()
    return 0


def mended(words: list[str], at: str) -> tuple[list[str], int, str]:
    """Put together what bash has torn apart at ``=``, ``@`` and ``:``.

    Returns
    -------
    tuple
        The words, which one the cursor is in, and how much of that one bash keeps when it puts an answer in.
    """
    cursor = int(at) if at.isdecimal() else len(words)
    words = [*words, *[""] * (cursor + 1 - len(words))]
    whole: list[str] = []
    glue, place, kept = False, 0, ""
    for number, word in enumerate(words):
        torn = word[:1] in ("=", ":") or (word[:1] == "@" and bool(whole) and whole[-1].endswith(","))
        if (glue or torn) and len(whole) > 1 and (word or number == cursor):
            before, whole[-1] = whole[-1], whole[-1] + word
        else:
            before = ""
            whole.append(word)
        if number == cursor:
            # Directly behind a = or : bash puts the answer behind it; an @ it replaces together with what follows.
            place, kept = len(whole) - 1, (before + (word if word in ("=", ":") else "")).removesuffix("@")
        glue = word[-1:] in ("=", ":") or word == "@"
    return whole, place, kept


def _quoted(words: Iterable[str]) -> str:
    """Join words so that splitting like a shell gives them back; half a quote stays as it is."""
    return "\n".join(word.replace("[", "\\[") if word else "''" for word in words)
