"""Describes the wire for other programs: the JSON Schema of each message, and the table of keys with their rights."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import msgspec

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.identity.access import TOPICS, table
from fullswarm.messages import Message

DRAFT = "https://json-schema.org/draft/2020-12/schema"
BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
HEAD = """
# Reference: messages and keys

`fullswarm schema --page` prints this page; it is made of the code. `fullswarm schema NAME` prints the JSON Schema of
one message, `fullswarm schema --out DIR` writes all of them, and the keys, as files.

A message is a MessagePack map, published on a key of zenoh. Its field `kind` has the message's name and version. A
receiver refuses an unknown version, an unknown field, and a value out of bounds. A key is `<swarm>/<sender>/` and one
of those below: the sender is the name of the process (an operator: `operator`), at a secured hub that in its
certificate. Units are in the names of fields (`_m`, `_m_s`, `_rad`, `_s`); the frame is east-north-up. NaN says unknown
where a number may be unknown. `stamp_s` is the sender's monotonic clock. In JSON, as in recordings, bytes are Base64.
"""


def messages() -> dict[str, type[Message]]:
    """Return all messages of the bus by name, in alphabetical order."""
    found = {kind.__name__: kind for topic in TOPICS for kind in topic.messages}
    return dict(sorted(found.items()))


def message_named(name: str) -> type[Message]:
    """Return a message by its name.

    Raises
    ------
    ConfigError
        There is none.
    """
    known = messages()
    if name not in known:
        raise ConfigError(f"no message '{name:.64}'", where="schema", hint=did_you_mean(name[:64], known))
    return known[name]


def tag_of(kind: type[Message]) -> str:
    """Return what the field ``kind`` of a message holds on the wire: its name and version, ``Ping/1``."""
    return str(kind.__struct_config__.tag)


def write_all(folder: Path) -> list[Path]:
    """Write the schema of each message to ``NAME.json`` in a folder, and the table of keys to ``keys.json``.

    Raises
    ------
    ConfigError
        It cannot be written.
    """
    contents: dict[str, object] = {name: json_schema(kind) for name, kind in messages().items()}
    contents["keys"] = keys()
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            path = folder / f"{name}.json"
            path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            written.append(path)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(folder)) from error
    return written


def keys() -> list[dict[str, object]]:
    """Return the keys of the bus: each with its messages, and who may publish and receive it.

    A right is a role and which values the restricted chunk of the key may have: ``*`` any, ``<own>`` the holder's name.
    """
    return [
        {
            "key": f"<swarm>/<sender>/{topic.key}",
            "messages": [tag_of(kind) for kind in topic.messages],
            "publish": dict(topic.publish),
            "receive": dict(topic.receive),
        }
        for topic in TOPICS
    ]


def page() -> str:
    """Return all messages and keys as the page ``docs/reference-messages.md``."""
    lines = [HEAD.rstrip(), "", "## Keys", "", table(), "", "## Messages"]
    for name, kind in messages().items():
        topics = [topic for topic in TOPICS if kind in topic.messages]
        about = (inspect.getdoc(kind) or "").partition("\n\n")[0]
        where = ", ".join(f"`{topic.key}`" for topic in topics)
        lines += ["", f"### {name}", "", f"{' '.join(about.split())} Kind: `{tag_of(kind)}`. Key: {where}.", ""]
        lines += _fields(json_schema(kind))
    lines += ["", "## Parts of messages"]
    parts = {name: each for kind in messages().values() for name, each in json_schema(kind)["$defs"].items()}
    for name, each in sorted(parts.items()):
        lines += ["", f"### {name}", "", " ".join(each.get("description", "").partition("\n\n")[0].split()), ""]
        lines += _fields(each) if "properties" in each else [f"A {_type(each)}, in this order."]
    return "\n".join(lines) + "\n"


def _fields(schema: dict[str, Any]) -> list[str]:
    required = set(schema.get("required", ()))
    rows = ["| field | type | default |", "|---|---|---|"]
    for field, each in schema.get("properties", {}).items():
        if field == "kind":
            continue
        default = "required" if field in required else f"`{json.dumps(each.get('default'))}`"
        rows.append(f"| `{field}` | {_type(each)} | {default} |")
    return rows


def _type(schema: dict[str, Any]) -> str:
    """Return a type in words, for people; the schema itself has all bounds."""
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(map(_type, schema["anyOf"])))
    if "enum" in schema:
        return ", ".join(f"`{each}`" for each in schema["enum"])
    kind = str(schema.get("type", "any value"))
    if kind == "array" and "items" in schema and schema["items"]:
        return f"list of {_type(schema['items'])}"
    if kind == "array":
        return "list of " + ", ".join(dict.fromkeys(map(_type, schema.get("prefixItems", ({},)))))
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"table of {_type(schema['additionalProperties'])}"
    bounds = [f"{sign} {schema[name]:g}" for name, sign in BOUNDS.items() if name in schema]
    return f"{kind} {' and '.join(bounds)}" if bounds else kind


def json_schema(kind: type[Message]) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a message, an object at the top."""
    found = msgspec.json.schema(kind, schema_hook=lambda _: {"description": "any value"})
    definitions = found["$defs"]
    own = definitions.pop(found["$ref"].rpartition("/")[2])
    return {"$schema": DRAFT, **own, "$defs": definitions}
