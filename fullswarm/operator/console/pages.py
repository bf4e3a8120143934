"""The page's files, and nothing but them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

FOLDER = Path(__file__).with_name("page")
INDEX = "index.html"
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".ico": "image/x-icon",
    ".txt": "text/plain; charset=utf-8",
    ".webmanifest": "application/manifest+json",
}


@dataclass(frozen=True, slots=True)
class Pages:
    """Serves a folder: only files that lie in it, only of types that a page is made of."""

    folder: Path = FOLDER

    def find(self, name: str) -> Path | None:
        """Return the file of that name; None when there is none to be given out."""
        if "\0" in name:
            return None
        try:
            folder = self.folder.resolve()
            path = (folder / name).resolve()
            return path if path.is_relative_to(folder) and path.suffix in TYPES and path.is_file() else None
        except (OSError, ValueError):  # a name that no file can have
            return None

    async def serve(self, request: Request) -> Response:
        """Answer a request for a file, or with "not modified"."""
        path = self.find(request.path_params.get("name", INDEX))
        if path is None:
            return PlainTextResponse("no such page", 404)
        data = path.read_bytes()
        tag = f'"{hashlib.sha256(data).hexdigest()[:32]}"'
        # Kept by the browser, but asked about each time: an update of the package must not mix with the old page.
        headers = {"ETag": tag, "Cache-Control": "no-cache"}
        known = {each.strip().removeprefix("W/") for each in request.headers.get("if-none-match", "").split(",")}
        if tag in known:
            return Response(status_code=304, headers=headers)
        return Response(data, media_type=TYPES[path.suffix], headers=headers)
