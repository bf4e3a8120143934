"""A short live rehearsal: real processes are killed, paused and cut off while operators ask."""

from __future__ import annotations

import pytest

from fullswarm.rehearse.live.rehearsal import rehearse_live, text_of

pytestmark = pytest.mark.slow


def test_under_faults_what_is_asked_happens_once_and_in_order_and_nothing_else_does() -> None:
    report = rehearse_live(robots=4, seconds=60.0, every_s=3.0, seed=1, loss=0.01)
    assert not report.failed, text_of(report)
    assert len(report.recoveries) >= 10
    assert report.executions > 50
