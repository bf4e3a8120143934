"""The syntax of Stage's world files: properties, entities in parentheses, ``define``, ``include``.

After libstage/worldfile.cc: words may hold indices (``point[0]``), tuples stand in brackets, ``#`` begins a comment.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.importers.files import read_text

Value = str | tuple[str, ...]
MAX_DEPTH = 20
MAX_ENTITIES = 50_000

_TOKEN = re.compile(
    r"""(?P<space>[ \t\r\f\v]+)|(?P<comment>\#[^\n]*)|(?P<newline>\n)|"(?P<string>[^"\n]*)"
    |(?P<word>[A-Za-z_][\w.\-/]*(?:\[\d+\][\w.]*)*)|(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)
    |(?P<mark>[()\[\]])""",
    re.VERBOSE,
)


@dataclass(frozen=True, slots=True)
class Token:
    """A word, number, string or mark, and its line."""

    kind: str
    text: str
    where: str


@dataclass(slots=True)
class Entity:
    """Something with a type, properties and parts."""

    kind: str
    where: str
    properties: dict[str, Value] = field(default_factory=dict)
    parts: list[Entity] = field(default_factory=list)


@dataclass(slots=True)
class WorldFile:
    """Entities of a file and of all that it includes; what a defined type is made of."""

    root: Entity
    defined: dict[str, Entity] = field(default_factory=dict)
    """By the new type's name; the entity's `kind` is the type below it."""
    missing: list[str] = field(default_factory=list)
    """Includes that are not there."""
    entities: int = 0


def parse(path: Path) -> WorldFile:
    """Return what a world file says, includes and all.

    Raises
    ------
    ConfigError
        Not readable, or not in this syntax: told with its line.
    """
    world = WorldFile(Entity("world", str(path)))
    _parse_into(world, path, 0)
    return world


def _parse_into(world: WorldFile, path: Path, depth: int) -> None:
    if depth > MAX_DEPTH:
        raise ConfigError(f"more than {MAX_DEPTH} files include one another", where=str(path))
    tokens = list(_tokens(read_text(path, "Stage world"), path))
    position = 0
    while position < len(tokens):
        token = tokens[position]
        if token.kind == "word" and token.text == "include":
            name = _expect(tokens, position + 1, "string", token)
            included = path.parent / name.text
            if included.is_file():
                _parse_into(world, included, depth + 1)
            else:
                world.missing.append(name.text)
            position += 2
        elif token.kind == "word" and token.text == "define":
            new = _expect(tokens, position + 1, "word", token)
            below = _expect(tokens, position + 2, "word", token)
            _expect(tokens, position + 3, "(", token)
            entity = Entity(below.text, new.where)
            position = _body(world, tokens, position + 4, entity, 0)
            world.defined[new.text] = entity
        else:
            position = _statement(world, tokens, position, world.root, 0)


def _tokens(text: str, path: Path) -> Iterator[Token]:
    line, position = 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise ConfigError(f"not expected here: '{text[position]}'", where=f"{path}:{line}")
        kind, position = match.lastgroup or "", match.end()
        if kind == "newline":
            line += 1
        elif kind not in ("space", "comment"):
            found = match.group(kind)
            yield Token(found if kind == "mark" else kind, found, f"{path}:{line}")


def _expect(tokens: list[Token], position: int, kind: str, after: Token) -> Token:
    if position >= len(tokens) or tokens[position].kind != kind:
        found = f"'{tokens[position].text}'" if position < len(tokens) else "the end of the file"
        raise ConfigError(f"after '{after.text}' should come a {kind}, not {found}", where=after.where)
    return tokens[position]


def _statement(world: WorldFile, tokens: list[Token], position: int, owner: Entity, depth: int) -> int:
    """Read a property or a part of `owner`; return where the next one begins."""
    name = tokens[position]
    if name.kind != "word":
        raise ConfigError(f"not expected here: '{name.text}'", where=name.where)
    if position + 1 >= len(tokens):
        raise ConfigError(f"'{name.text}' has no value", where=name.where)
    value = tokens[position + 1]
    if value.kind == "(":
        world.entities += 1
        if depth > MAX_DEPTH or world.entities > MAX_ENTITIES:
            raise ConfigError("too many entities, or too deep in one another", where=name.where)
        part = Entity(name.text, name.where)
        owner.parts.append(part)
        return _body(world, tokens, position + 2, part, depth + 1)
    if value.kind == "[":
        end = position + 2
        while end < len(tokens) and tokens[end].kind in ("number", "word", "string"):
            end += 1
        _expect(tokens, end, "]", tokens[end - 1])
        owner.properties[name.text] = tuple(token.text for token in tokens[position + 2 : end])
        return end + 1
    if value.kind in ("number", "string", "word"):
        owner.properties[name.text] = value.text
        return position + 2
    raise ConfigError(f"'{name.text}' has no value", where=name.where)


def _body(world: WorldFile, tokens: list[Token], position: int, entity: Entity, depth: int) -> int:
    while position < len(tokens):
        if tokens[position].kind == ")":
            return position + 1
        position = _statement(world, tokens, position, entity, depth)
    raise ConfigError(f"the parenthesis of '{entity.kind}' is not closed", where=entity.where)
