"""What holds for all tests."""

from collections.abc import Iterator

import pytest
import structlog
from hypothesis import HealthCheck, settings

# Machines are noisy: how long an example took says nothing about the code.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


@pytest.fixture(autouse=True)
def _usual_logs() -> Iterator[None]:
    """Undo what a command that runs within a test has changed: it sends its log lines elsewhere."""
    yield
    structlog.reset_defaults()
