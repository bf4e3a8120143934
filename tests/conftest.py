"""What holds for all tests."""

from hypothesis import HealthCheck, settings

# Machines are noisy: how long an example took says nothing about the code.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
