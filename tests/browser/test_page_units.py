"""The page's pure modules, tested by node."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

NODE = shutil.which("node")
ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(NODE is None, reason="no node here: apt install nodejs")
def test_the_modules_that_need_no_page() -> None:
    assert NODE is not None
    files = sorted(map(str, (ROOT / "tests" / "browser" / "page").glob("*.test.mjs")))
    assert files
    done = subprocess.run([NODE, "--test", *files], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
