"""What holds for all tests."""

import os
from collections.abc import Iterator

import pytest
import structlog
from hypothesis import HealthCheck, settings

# Machines are noisy: how long an example took says nothing about the code. CI tries the same examples each
# time, so that it tells of the change at hand; `make test-all` looks for new ones.
USUAL = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("repeatable", USUAL, derandomize=True)
settings.register_profile("searching", USUAL)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


@pytest.fixture(autouse=True, scope="session")
def _state(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep what survives processes (audit logs, latches) out of the user's own state folder."""
    os.environ.setdefault("FULLSWARM_STATE", str(tmp_path_factory.mktemp("state")))


@pytest.fixture(autouse=True)
def _usual_logs() -> Iterator[None]:
    """Undo what a command that runs within a test has changed: it sends its log lines elsewhere."""
    yield
    structlog.reset_defaults()
