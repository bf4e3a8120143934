"""axe-core from npm: what a reader of screens, a keyboard and weak eyes need of a page."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import Page

VERSION = json.loads(Path(__file__).with_name("package.json").read_text())["devDependencies"]["axe-core"]
NPM = shutil.which("npm")


def axe_source() -> str:
    """Return axe-core's code, fetched by npm once and then kept beside the interpreter's packages."""
    kept = Path(sys.prefix) / "share" / f"axe-core-{VERSION}.js"
    if not kept.exists():
        assert NPM is not None
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                [NPM, "pack", "--silent", f"axe-core@{VERSION}"],
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=120,
            )
            assert done.returncode == 0, f"npm could not fetch axe-core {VERSION}:\n{done.stderr}"
            with tarfile.open(next(Path(folder).glob("*.tgz"))) as archive:
                member = archive.extractfile("package/axe.min.js")
                assert member is not None
                kept.write_bytes(member.read())
    return kept.read_text()


def violations(page: Page) -> list[str]:
    """Return what axe-core finds wrong, one line each."""
    page.evaluate(axe_source())
    found: dict[str, Any] = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
    return [
        f"{each['id']}: {each['help']}: {node['html'][:160]} ({node['failureSummary']})"
        for each in found["violations"]
        for node in each["nodes"]
    ]
