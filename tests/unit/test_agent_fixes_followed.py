"""Fixes on the bus: an agent whose robot feels its wheels only, and somebody who sees it."""

from __future__ import annotations

import pytest

from tests.unit import fix_lab
from tests.unit.fix_lab import TIMEOUT_S, Lab, seen

lab = fix_lab.lab


def test_without_fixes_the_pose_is_odometry_on_the_start_pose(lab: Lab) -> None:
    lab.drive(1.0, 0.3)
    lab.run(1.0)
    assert lab.pose == pytest.approx(lab.truth(), abs=0.01)
    health = lab.now()
    assert (health.pose_source, health.pose_note) == ("odometry", "")
    assert health.position_sigma_m > 0.05  # of the start pose, and growing


def test_the_first_fix_says_where_it_is_and_the_health_report_where_from(lab: Lab) -> None:
    lab.origin = (-3.0, 4.0, 2.0)
    lab.seeing = True
    lab.run(0.06)
    assert lab.health.pose_source == "fixes"  # told at once, not with the next report
    assert lab.pose == pytest.approx(lab.truth(), abs=1e-6)
    assert 0.0 < lab.now().position_sigma_m <= 0.011
    assert lab.states[-1].x_m[0] == pytest.approx(1.0) or lab.states[-1].x_m[0] == pytest.approx(-3.0)
    lab.run(0.1)
    assert lab.states[-1].x_m[0] == pytest.approx(-3.0)


def test_it_follows_while_it_drives(lab: Lab) -> None:
    seen(lab).drive(1.0, 0.5)
    for _ in range(100):
        lab.tick()
        assert lab.pose[:2] == pytest.approx(lab.truth()[:2], abs=0.01)


def test_a_lost_source_degrades_to_odometry_says_so_and_comes_back_by_itself(
    lab: Lab, capsys: pytest.CaptureFixture[str]
) -> None:
    seen(lab).drive(1.0, 0.2)
    lab.run(0.5)
    lab.seeing = False
    lost_s = lab.runtime.now_s()
    while lab.health.pose_source == "fixes":
        lab.tick()
    assert lab.runtime.now_s() - lost_s <= TIMEOUT_S + 0.15
    assert lab.health.pose_note == "its fixes have stopped; odometry alone"
    assert "its fixes have stopped; odometry alone" in capsys.readouterr().out
    sigmas = []
    for _ in range(4):
        lab.run(1.0)
        sigmas.append(lab.now().position_sigma_m)
        assert lab.pose[:2] == pytest.approx(lab.truth()[:2], abs=0.05)
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] > 2.0 * sigmas[0]
    lab.seeing = True
    lab.run(0.1)
    assert (lab.health.pose_source, lab.health.pose_note) == ("fixes", "")
    assert "fixes are used" in capsys.readouterr().out
