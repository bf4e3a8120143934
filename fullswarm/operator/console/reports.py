"""Serves the reports of experiments, with the files that they link to, under addresses that only pages are told.

A report that is older than its trials is made first, by `fullswarm results report` in a process of its own.
"""

from __future__ import annotations

import asyncio
import re
import tempfile
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route

from fullswarm.operator.console import children
from fullswarm.operator.console.experiments import Entry, Experiments

PATH = "/report"
REPORT, TABLE = "report.html", "results.csv"
LONGEST_S, LOOK_S = 900.0, 0.1
POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; sandbox allow-downloads"
)
"""A report is one file with styles and pictures inside. It runs no script, and has an origin of its own: nothing in it
can act as the console's page."""
_NAME = r"[A-Za-z0-9_+=,@%~()\[\]-][A-Za-z0-9._+=,@%~()\[\]-]{0,254}"
_LINKED = re.compile(rf"(results\.csv|index\.sqlite|trials/{_NAME}/{_NAME}|recordings/{_NAME}\.mcap)\Z")


class Reports:
    """Answers requests for reports."""

    def __init__(self, experiments: Experiments) -> None:
        self._experiments = experiments
        self._making: dict[str, asyncio.Task[str]] = {}
        self._one = asyncio.Lock()

    def route(self) -> Route:
        """Return what answers requests for reports and their files."""
        return Route(f"{PATH}/{{key}}/{{name:path}}", self._answer)

    def close(self) -> None:
        """End what is being made."""
        for task in self._making.values():
            task.cancel()

    async def _answer(self, request: Request) -> Response:
        found = self._experiments.reported(request.path_params["key"])
        if found is None:
            return PlainTextResponse("there is no such report: open it from the console again", 404)
        entry, refusal = found
        if refusal:
            return PlainTextResponse(refusal, 409)
        name = request.path_params["name"]
        if name:
            return self._file(entry, name)
        fresh = entry.results is not None and entry.results.report == "fresh"
        if not fresh and (problem := await self._make(entry)):
            return PlainTextResponse(f"no report: {problem}", 500)
        return self._file(entry, REPORT)

    def _file(self, entry: Entry, name: str) -> Response:
        """Return a file of a results folder: the report, or one that reports link to."""
        folder = Path(entry.out)
        path = folder / name
        try:
            there = path.resolve().is_relative_to(folder.resolve()) and path.is_file()
        except (OSError, ValueError):
            there = False
        if not there or not (name == REPORT or _LINKED.match(name)):
            return PlainTextResponse("there is no such file", 404)
        headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-store"}
        if name == REPORT:
            return FileResponse(path, media_type="text/html; charset=utf-8", headers=headers)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name, headers=headers)

    async def _make(self, entry: Entry) -> str:
        """Have the report made, once for all who ask meanwhile; return what was wrong, or empty."""
        task = self._making.get(entry.id)
        if task is None:
            task = self._making[entry.id] = asyncio.create_task(self._run(entry))
            task.add_done_callback(lambda _: self._making.pop(entry.id, None))
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            if task.cancelled():
                return "the console has ended"
            raise

    async def _run(self, entry: Entry) -> str:
        async with self._one:
            with tempfile.TemporaryFile() as log:
                try:
                    process = children.start(["results", "report", entry.out], log)
                except OSError as error:
                    return error.strerror or str(error)
                loop = asyncio.get_running_loop()
                late_s = loop.time() + LONGEST_S
                try:
                    while process.poll() is None:
                        if loop.time() > late_s:
                            return f"it took longer than {LONGEST_S / 60.0:.0f} minutes"
                        await asyncio.sleep(LOOK_S)
                finally:
                    children.end(process)
                if process.returncode:
                    return children.last_line(log) or f"exit code {process.returncode}"
        self._experiments.report_made(entry)
        return ""
