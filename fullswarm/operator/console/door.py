"""Opens the page in the user's browser without its token on a command line, which other users can read."""

from __future__ import annotations

import contextlib
import html
import json
import os
import tempfile
import webbrowser
from pathlib import Path

OPEN_S = 60.0
"""A browser that has not read the file by then will not."""
PAGE = """<!doctype html>
<meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>fullswarm</title>
<script>location.replace({script})</script>
<noscript><a href="{link}">the console</a></noscript>
"""


class Door:
    """A file that only this user can read, and that leads a browser on to an address. It must be closed."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._file: Path | None = None

    def open(self) -> bool:
        """Have the user's browser shown in; False when there is none."""
        try:
            self._file = _written(PAGE.format(script=_quoted(self._address), link=html.escape(self._address)))
        except OSError:
            return False
        return webbrowser.open(self._file.as_uri())

    def close(self) -> None:
        """Take the file away; closing twice is fine."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.unlink(missing_ok=True)
            self._file = None


def _quoted(text: str) -> str:
    """Return a string of JavaScript that cannot end the script it stands in."""
    return json.dumps(text).replace("<", "\\u003c")


def _written(page: str) -> Path:
    # Not in /tmp and not in a hidden folder: a browser from a snap or a flatpak cannot see those.
    for folder in (Path.home(), Path(tempfile.gettempdir())):
        with contextlib.suppress(OSError):
            descriptor, name = tempfile.mkstemp(".html", "fullswarm-console-", folder)  # mode 0600
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(page)
            return Path(name)
    raise OSError("neither the home folder nor the one for temporary files can be written")
