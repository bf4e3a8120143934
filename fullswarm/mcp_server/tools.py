"""A tool of the server: what it is called with, what it does to the swarm, and how its errors are answered."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import structlog
from mcp_types import CallToolResult, TextContent, ToolAnnotations
from mcp_types import Tool as ToolDescription
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.mcp_server.limits import plain

log = structlog.get_logger()

LARGEST_ANSWER = 200_000
"""Bytes of JSON; a language model has a use for a fraction of it."""

Robot = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
Robots = Annotated[list[Robot], Field(max_length=1000)]
Name = Annotated[str, Field(max_length=64)]
Kind = Literal["read", "stop", "hold", "move"]
"""What a tool does: reads; stops robots; changes who may move them; moves them."""


class Arguments(BaseModel):
    """What a tool is called with: nothing that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True, slots=True)
class Tool:
    """A tool.

    Parameters
    ----------
    text : for the model: what it does, when to use it
    arguments : the model of its arguments
    call : receives an object of that model; returns a table
    """

    name: str
    kind: Kind
    text: str
    arguments: type[Arguments]
    call: Callable[[Any], Awaitable[dict[str, Any]]]

    def described(self) -> ToolDescription:
        """Return what a client is shown."""
        schema = self.arguments.model_json_schema()
        schema.pop("description", None)
        return ToolDescription(
            name=self.name,
            description=self.text,
            input_schema={"type": "object", **schema},
            annotations=ToolAnnotations(
                title=self.name.replace("_", " "),
                read_only_hint=self.kind == "read",
                destructive_hint=self.kind == "move",
                idempotent_hint=self.kind != "move",
                open_world_hint=self.kind == "move",
            ),
        )

    async def answer(self, given: dict[str, Any]) -> CallToolResult:
        """Call the tool; whatever goes wrong is an answer for the model, in the form of all errors."""
        try:
            found = await self.call(self.arguments.model_validate(given))
            return _answer(plain(found), self.name)
        except ValidationError as error:
            return failed(_explained(error, self.name))
        except FullswarmError as error:
            return failed(error)
        except Exception as error:
            log.error("mcp.tool_failed", tool=self.name, error=f"{type(error).__name__}: {error}")
            return failed(FullswarmError(f"{type(error).__name__}, a bug in fullswarm", where=self.name))


def _answer(found: dict[str, Any], name: str) -> CallToolResult:
    text = json.dumps(found, ensure_ascii=False, allow_nan=False)
    if len(text.encode()) > LARGEST_ANSWER:
        raise ConfigError(
            f"the answer has more than {LARGEST_ANSWER} bytes", where=name, hint="name robots, or a smaller limit"
        )
    return CallToolResult(content=[TextContent(text=text)], structured_content=found)


def failed(error: FullswarmError) -> CallToolResult:
    """Return the answer of a tool that failed: one line as text, and its parts for programs."""
    parts = {
        "what": error.what, "where": error.where, "hint": error.hint, "code": error.code, "exit_code": error.exit_code,
    }  # fmt: skip
    return CallToolResult(
        content=[TextContent(text=plain(str(error)))], structured_content={"error": plain(parts)}, is_error=True
    )


def _explained(error: ValidationError, name: str) -> ConfigError:
    """Return what is wrong with arguments, without repeating them: they may be long."""
    wrong = [
        f"{'.'.join(str(part) for part in each['loc'])[:64] or 'arguments'}: {each['msg']}"
        for each in error.errors(include_url=False, include_context=False, include_input=False)[:5]
    ]
    return ConfigError("; ".join(wrong), where=name, hint="see the tool's input schema")
