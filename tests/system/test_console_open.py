"""``fullswarm console --open``: what other users of this machine can see of it."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import unquote, urlsplit

BROWSER = """#!/bin/sh
# A browser that looks at its own command line, as anybody with `ps` can, and at the page that it was told to open.
tr '\\000' ' ' < /proc/$$/cmdline > "$HOME/seen"
printf %s "$1" > "$HOME/opened.part" && mv "$HOME/opened.part" "$HOME/opened"
"""
WAIT_S = 30.0


def test_nobody_else_reads_the_token_off_the_browser(tmp_path: Path) -> None:
    browser = tmp_path / "browser"
    browser.write_text(BROWSER)
    browser.chmod(0o755)
    environment = {**os.environ, "HOME": str(tmp_path), "BROWSER": f"{browser} %s"}
    command = [sys.executable, "-m", "fullswarm", "console", "--open", "--json", "--listen", "127.0.0.1:0"]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as console:
        try:
            assert console.stdout is not None
            address = str(json.loads(console.stdout.readline())["url"])
            token = address.partition("#token=")[2]
            opened = tmp_path / "opened"
            deadline = time.monotonic() + WAIT_S
            while not opened.exists():
                assert time.monotonic() < deadline, "no browser was opened"
                time.sleep(0.02)
            assert len(token) >= 16
            assert token not in (tmp_path / "seen").read_text()
            page = Path(unquote(urlsplit(opened.read_text()).path))
            assert stat.S_IMODE(page.stat().st_mode) == 0o600
            assert token in page.read_text()
        finally:
            console.terminate()
            console.wait(10.0)
    assert not page.exists()
