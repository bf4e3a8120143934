"""Reading other simulators' files: bytes, XML with line numbers, numbers; and errors that name the place."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.errors import ConfigError, MissingExtra

MAX_BYTES, MAX_DEPTH = 50_000_000, 100
LARGEST = 1e9
"""A larger number is no place and no size: it would only overflow later."""

INSTALL = "pip install 'fullswarm[experiments]'"

ROBOT_LIKE = re.compile(
    r"robot|bot(?![a-z])|turtle|create|roomba|rover|husky|jackal|pioneer|e-?puck|khepera|kobuki|vehicle|agv|tb[34]",
    re.I,
)
"""Names under which worlds keep their robots."""


@dataclass(slots=True)
class Node:
    """An element of an XML file, and the line on which it begins."""

    tag: str
    attributes: dict[str, str]
    where: str
    children: list[Node] = field(default_factory=list)
    text: str = ""

    @property
    def name(self) -> str:
        """How to call it: its name or id, else its tag."""
        return self.attributes.get("name") or self.attributes.get("id") or self.tag

    def all(self, tag: str) -> Iterator[Node]:
        """Yield the children of a tag."""
        return (child for child in self.children if child.tag == tag)

    def child(self, tag: str) -> Node | None:
        """Return the first child of a tag."""
        return next(self.all(tag), None)

    def need(self, tag: str) -> Node:
        """Return the first child of a tag.

        Raises
        ------
        ConfigError
            There is none.
        """
        found = self.child(tag)
        if found is None:
            raise ConfigError(f"<{self.tag}> without <{tag}>", where=self.where)
        return found

    def attribute(self, key: str) -> str:
        """Return an attribute.

        Raises
        ------
        ConfigError
            It is not there.
        """
        if key not in self.attributes:
            raise ConfigError(f"<{self.tag}> without the attribute '{key}'", where=self.where)
        return self.attributes[key]

    def number(self, key: str, default: float | None = None) -> float:
        """Return an attribute as a number; `default` when it is not there and one is given."""
        if default is not None and key not in self.attributes:
            return default
        return numbers(self.attribute(key), 1, f"{self.tag}.{key}", self.where)[0]


def numbers(text: str, count: int, what: str, where: str) -> tuple[float, ...]:
    """Return the first `count` numbers of a text, between which stand spaces or commas.

    Raises
    ------
    ConfigError
        Fewer than `count`, something else than a number, or one that is beyond `LARGEST`.
    """
    words = text.replace(",", " ").split()
    try:
        values = tuple(float(word) for word in words)
    except ValueError as error:
        raise ConfigError(f"{what}: '{text.strip()}' is not made of numbers", where=where) from error
    if len(values) < count or not all(abs(value) <= LARGEST for value in values):
        raise ConfigError(f"{what}: '{text.strip()}' should be {count} finite numbers", where=where)
    return values[:count]


def read_bytes(path: Path, what: str) -> bytes:
    """Return what is in a file.

    Raises
    ------
    ConfigError
        It cannot be read, or is larger than a world's description can be.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(f"the {what} is larger than {MAX_BYTES // 1_000_000} MB", where=str(path))
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read the {what}: {error.strerror or error}", where=str(path)) from error


def read_text(path: Path, what: str) -> str:
    """Return the text in a file; bytes that are not UTF-8, as old files have in comments, are replaced."""
    return read_bytes(path, what).decode("utf-8-sig", "replace")


def read_xml(path: Path, what: str) -> Node:
    """Return the root of an XML file. Entities and external references are refused (defusedxml).

    Raises
    ------
    ConfigError
        Not readable or not XML; the line is named.
    MissingExtra
        defusedxml is not installed.
    """
    data = read_bytes(path, what)
    try:
        from defusedxml import DefusedXmlException
        from defusedxml import sax as safe_sax
    except ImportError as error:
        raise MissingExtra("reading XML worlds needs defusedxml", hint=INSTALL) from error
    from xml.sax import SAXParseException
    from xml.sax.handler import ContentHandler
    from xml.sax.xmlreader import AttributesImpl, Locator

    class Builder(ContentHandler):
        """Makes nodes of events."""

        def __init__(self) -> None:
            super().__init__()
            self.place: Locator | None = None
            self.root: Node | None = None
            self.open: list[Node] = []

        def setDocumentLocator(self, locator: Locator) -> None:  # noqa: N802 - SAX's name
            self.place = locator

        def startElement(self, name: str, attrs: AttributesImpl) -> None:  # noqa: N802 - SAX's name
            line = self.place.getLineNumber() if self.place else None
            node = Node(name, dict(attrs.items()), f"{path}:{line}")
            if len(self.open) > MAX_DEPTH:
                raise ConfigError(f"elements more than {MAX_DEPTH} deep in one another", where=node.where)
            if self.open:
                self.open[-1].children.append(node)
            else:
                self.root = node
            self.open.append(node)

        def endElement(self, name: str) -> None:  # noqa: N802, ARG002 - SAX's name and arguments
            self.open.pop()

        def characters(self, content: str) -> None:
            if self.open:
                self.open[-1].text += content

    builder = Builder()
    try:
        safe_sax.parseString(data, builder)
    except SAXParseException as error:
        raise ConfigError(f"not valid XML: {error.getMessage()}", where=f"{path}:{error.getLineNumber()}") from error
    except DefusedXmlException as error:
        raise ConfigError("XML with entities of its own is not read: it may be an attack", where=str(path)) from error
    except (ValueError, LookupError) as error:
        raise ConfigError(f"not valid XML: {error}", where=str(path)) from error
    if builder.root is None:
        raise ConfigError("not valid XML: it is empty", where=str(path))
    return builder.root
