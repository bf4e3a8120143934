"""Documents and schemas that a model may read."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

from mcp_types import ReadResourceResult, Resource, TextResourceContents

from fullswarm import schemas
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.reasons import TEXTS, Code

SCHEME = "fullswarm://"
SCHEMA = f"{SCHEME}schema/"


@dataclass(frozen=True, slots=True)
class Document:
    """A document: what it is, its type, and its text."""

    about: str
    mime: str
    text: Callable[[], str]


class Documents:
    """The documents of the server.

    Parameters
    ----------
    guide : the page of `fullswarm guide`
    """

    def __init__(self, guide: str) -> None:
        self._fixed = {
            f"{SCHEME}guide": Document("How to use and extend fullswarm, in one page", "text/markdown", lambda: guide),
            f"{SCHEME}reasons": Document("Codes of reasons and their texts", "application/json", _reasons),
            f"{SCHEME}keys": Document("Keys of the bus: who may publish and receive what", "text/markdown", _keys),
        }

    def listed(self) -> list[Resource]:
        """Return all of them, a schema per message among them."""
        found = [
            Resource(uri=uri, name=uri.removeprefix(SCHEME), description=each.about, mime_type=each.mime)
            for uri, each in self._fixed.items()
        ]
        return found + [
            Resource(uri=SCHEMA + name, name=f"schema/{name}", description=_about(name), mime_type="application/json")
            for name in schemas.messages()
        ]

    def read(self, uri: str) -> ReadResourceResult:
        """Return one of them.

        Raises
        ------
        ConfigError
            There is none at this address.
        """
        if uri.startswith(SCHEMA):
            schema = schemas.json_schema(schemas.message_named(uri.removeprefix(SCHEMA)))
            return _contents(uri, "application/json", json.dumps(schema, indent=1))
        document = self._fixed.get(uri)
        if document is None:
            hint = did_you_mean(uri[:100], self._fixed)
            raise ConfigError(f"no resource '{uri:.100}'", where="resources/read", hint=hint)
        return _contents(uri, document.mime, document.text())


def _contents(uri: str, mime: str, text: str) -> ReadResourceResult:
    return ReadResourceResult(contents=[TextResourceContents(uri=uri, mime_type=mime, text=text)])


def _about(name: str) -> str:
    return f"JSON Schema of the message {name}"


def _reasons() -> str:
    return json.dumps({code.value: TEXTS.get(code, "") for code in Code if code.value}, indent=1)


def _keys() -> str:
    from fullswarm.identity.access import table

    return table()
