"""Log lines go to stderr, and structlog is loaded with the first of them."""

from __future__ import annotations

import subprocess
import sys

LATE = """
import sys
import fullswarm.operator.session, fullswarm.bus.zenoh_bus, fullswarm.operator.view
assert not {"structlog", "pydantic", "rich"} & set(sys.modules), "what each shell command loads"
from fullswarm.logs import Logger, log_to_stderr
log = Logger("late")
log_to_stderr(warnings_only=True, at_once=False)
assert "structlog" not in sys.modules
log.info("not wanted")
log.warning("a line", number=7)
log_to_stderr()
log.info("wanted now")
print("data")
"""


def test_a_logger_loads_structlog_with_its_first_line_and_writes_to_stderr() -> None:
    ran = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (0, "data\n"), ran.stderr
    assert "a line" in ran.stderr
    assert "number" in ran.stderr
    assert "wanted now" in ran.stderr
    assert "not wanted" not in ran.stderr


def test_a_later_choice_counts() -> None:
    program = """
from fullswarm.logs import Logger, log_to_stderr
log_to_stderr(warnings_only=True, at_once=False)
log_to_stderr()
Logger().info("all lines")
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert (ran.stdout, "all lines" in ran.stderr) == ("", True)
