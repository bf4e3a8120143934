"""The OpenAPI document (3.1) of the operations, made of their records, and the page that lists them for people."""

from __future__ import annotations

import html
import re
from typing import Any

import msgspec

from fullswarm import __version__
from fullswarm.operator.console.api import records
from fullswarm.operator.console.api.access import FIELD, FORM, JSON
from fullswarm.operator.console.api.problems import MEDIA_TYPE, TITLES, Problem
from fullswarm.operator.console.api.routes import BASE, OPERATIONS, Operation

ALWAYS = (400, 401, 429, 500)
"""Errors that every operation may answer with."""
OF_BODY = (408, 413, 415, 422)
OF_QUERY = (422,)
OF_CHANGE = (403,)
STREAM = "/stream"
ABOUT = """
Reads a swarm and commands it, for programs that cannot join its bus. Every call needs a token:
`fullswarm console tokens add NAME --api`. Units are in the names of fields; the frame is east-north-up; what is unknown
is null. Requests and twists need a lease of the robots, and go behind the safety filter; stops need neither.
"""
STREAMED = """
A WebSocket. Frames are JSON objects with a `type`: the client sends `subscribe`, `twists` and `release`, the server
`states`, `accepted` and `refused`. A client that cannot set the header Authorization sends `hello` first. Twists end
with their time to live, and with the connection. Closing codes: 4401 token, 4408 no hello, 1009 frame too large, 1008
too many frames, 1013 the client is too slow or too many streams are open.
"""


def document() -> dict[str, Any]:
    """Return the document."""
    kinds: list[Any] = [Problem, *records.FRAMES["client"], *records.FRAMES["server"]]
    for operation in OPERATIONS:
        kinds += [each for each in (operation.body, operation.returns) if each is not None and each not in kinds]
    _, schemas = msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")
    paths: dict[str, dict[str, Any]] = {}
    for operation in OPERATIONS:
        paths.setdefault(operation.path, {})[operation.method.lower()] = _described(operation)
    return {
        "openapi": "3.1.0",
        "info": {"title": "fullswarm", "version": __version__, "description": " ".join(ABOUT.split())},
        "servers": [{"url": BASE}],
        "security": [{"token": []}],
        "paths": paths,
        "x-stream": _stream(),  # a WebSocket is no operation of OpenAPI
        "components": {
            "schemas": schemas,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _described(operation: Operation) -> dict[str, Any]:
    found: dict[str, Any] = {
        "operationId": operation.name,
        "summary": operation.summary,
        "responses": {
            str(operation.status): {"description": "done", "content": {JSON: _ref(operation.returns)}},
            **{str(each): _problem(each) for each in _statuses(operation)},
        },
    }
    parameters = [
        {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
        for name in re.findall(r"{(\w+)}", operation.path)
    ]
    if operation.query is not None:
        parameters += _query(operation.query)
    if parameters:
        found["parameters"] = parameters
    if operation.body is not None:
        text = {"type": "string", "contentMediaType": JSON, "contentSchema": _ref(operation.body)["schema"]}
        form = {"type": "object", "properties": {FIELD: text}, "required": [FIELD], "additionalProperties": False}
        content = {JSON: _ref(operation.body), FORM: {"schema": form}}
        found["requestBody"] = {"required": True, "content": content}
    return found


def _statuses(operation: Operation) -> list[int]:
    more = OF_BODY if operation.body is not None else OF_QUERY if operation.query is not None else ()
    changes = () if operation.right == "read" else OF_CHANGE
    return sorted({*ALWAYS, *more, *changes, *operation.problems})


def _ref(kind: type[msgspec.Struct]) -> dict[str, Any]:
    return {"schema": {"$ref": f"#/components/schemas/{kind.__name__}"}}


def _problem(status: int) -> dict[str, Any]:
    found: dict[str, Any] = {"description": TITLES[status], "content": {MEDIA_TYPE: _ref(Problem)}}
    if status == 429:
        found["headers"] = {"Retry-After": {"schema": {"type": "integer"}, "description": "s"}}
    return found


def _query(kind: type[msgspec.Struct]) -> list[dict[str, Any]]:
    schema = msgspec.json.schema(kind)
    own = schema["$defs"][kind.__name__]
    return [
        {"name": name, "in": "query", "required": name in own.get("required", ()), "schema": each}
        for name, each in own["properties"].items()
    ]


def _stream() -> dict[str, Any]:
    names = {
        side: [{"$ref": f"#/components/schemas/{kind.__name__}"} for kind in kinds]
        for side, kinds in records.FRAMES.items()
    }
    return {
        "path": STREAM,
        "summary": "States at a rate, and twists, over a WebSocket.",
        "description": " ".join(STREAMED.split()),
        "frames": names,
    }


PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>fullswarm: REST interface</title></head><body>
<h1>fullswarm: REST interface, version 1</h1>
<p>{about}</p>
<p>The same for programs: <a href="{base}/openapi.json">openapi.json</a> (OpenAPI 3.1).</p>
<table><thead><tr><th>operation</th><th></th><th>role</th><th>receives</th><th>returns</th></tr></thead><tbody>
{rows}
</tbody></table>
<h2>Stream</h2>
<p>{stream}</p>
<h2>Records</h2>
{parts}
</body></html>
"""
ROLES = {"read": "observer", "change": "driver", "stop": "driver", "clear": "operator"}


def page() -> str:
    """Return the page: nothing on it is loaded, and it has no script."""
    described = document()
    rows = "\n".join(_row(operation) for operation in OPERATIONS)
    parts = "\n".join(_part(name, each) for name, each in sorted(described["components"]["schemas"].items()))
    return PAGE.format(about=_text(ABOUT), base=BASE, rows=rows, stream=_text(STREAMED), parts=parts)


def _text(text: str) -> str:
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(" ".join(text.split())))


def _row(operation: Operation) -> str:
    received = operation.body or operation.query
    cells = [
        f"<code>{operation.method} {html.escape(BASE + operation.path)}</code>",
        html.escape(operation.summary),
        ROLES[operation.right],
        _link(received.__name__) if received is operation.body and received is not None else _names(received),
        _link(operation.returns.__name__),
    ]
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _names(kind: type[msgspec.Struct] | None) -> str:
    return "" if kind is None else "?" + ", ".join(kind.__struct_fields__)


def _link(name: str) -> str:
    return f'<a href="#{name}">{name}</a>'


def _part(name: str, schema: dict[str, Any]) -> str:
    fields = "\n".join(
        f"<tr><td><code>{html.escape(field)}</code></td><td><code>{html.escape(_short(each))}</code></td></tr>"
        for field, each in schema.get("properties", {}).items()
    )
    about = html.escape(" ".join(schema.get("description", "").split()))
    return f'<h3 id="{name}">{name}</h3><p>{about}</p><table><tbody>{fields}</tbody></table>'


def _short(schema: dict[str, Any]) -> str:
    return msgspec.json.encode({key: each for key, each in schema.items() if key != "description"}).decode()
