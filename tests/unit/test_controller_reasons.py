"""The numbers that the kernels write are those of the enum that the rest reads."""

from __future__ import annotations

import pytest

from fullswarm.agent.motion import robot_controller
from fullswarm.agent.motion.robot_controller import CODES, StopReason
from fullswarm.reasons import TEXTS


@pytest.mark.parametrize("reason", StopReason)
def test_each_reason_has_its_number_in_the_kernels_and_its_words(reason: StopReason) -> None:
    assert getattr(robot_controller, reason.name) == reason.value
    assert CODES[reason] in TEXTS or reason is StopReason.HAZARD  # whose words are those of the hazards
