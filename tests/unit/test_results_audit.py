"""The audit: an independent recount agrees with the referee, and finds out a result or a motion that was changed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.config import WorldConfig
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.outcomes import Outcome
from fullswarm.evaluate.experiment.plan import Cell, Trial
from fullswarm.evaluate.lockstep_swarm import widened
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.results.audit import Audited, arrival_problem, audit, audit_trial
from fullswarm.evaluate.results.recount import recount
from fullswarm.evaluate.trial_folder import (
    EVIDENCE_FILE,
    PROVENANCE_FILE,
    RESULT_FILE,
    Evidence,
    Measurement,
    Record,
    arrays_of,
    digest_of,
    save_arrays,
    trial_id,
    write_trial,
)
from fullswarm.evaluate.witness import WorldWitness
from fullswarm.simulation.world import World

SIDE_M = 2.4


def trial(seed: int) -> Trial:
    return Trial(Cell("g", "hold", (), "empty", 5, "kinematic", "create"), seed, None, (), ())


def driven(seed: int, steps: int, engine: str = "kinematic", movers: int = 1) -> tuple[Record, Measurement]:
    """Let five robots of different sizes drive at random between two boxes: they touch often, and some not at all."""
    rng = np.random.default_rng(seed)
    config = WorldConfig.model_validate(
        {
            "engine": engine,
            "bounds_m": (0.0, 0.0, SIDE_M, SIDE_M),
            "boxes": [(1.2, 1.2, 0.3, 0.2, rng.uniform(0.0, 3.0)), (0.3, 1.3, 0.2, 0.2, 0.4)],
            "speed_limit_m_s": rng.choice([0.5, 2.0, 4.0]),
            "accel_limit_m_s2": 20.0,
            "movers": [{"waypoints": [(0.6, 2.2), (2.2, 1.7)], "speed_m_s": 0.6, "radius_m": 0.15}] * movers,
            "bodies": {"r1": {"radius_m": 0.1}, "r2": {"radius_m": 0.22}},
        }
    )
    starts = [(0.4, 0.4), (2.0, 0.4), (2.0, 2.0), (0.4, 2.0), (1.2, 0.4)]
    world = World(config, [f"r{row}" for row in range(5)], [(x, y, rng.uniform(-3.0, 3.0)) for x, y in starts])
    limits = world.limits[:, :2].copy()
    for row, each in enumerate(world.descriptions):
        world.set_limits(row, widened(each.limits))
    goals = rng.uniform(0.4, SIDE_M - 0.4, (5, 2))
    witness = WorldWitness(world, goals, 0.6, 0.5)
    witness.begin()
    for step in range(steps):
        if step % 25 == 0:
            twists = rng.uniform(-1.0, 1.0, (5, 2)) * limits
            twists[rng.integers(5)] *= rng.choice([0.0, 1.0, 3.0])
        world.set_twists(twists)
        world.step()
        witness.sample()
    world.close()
    counted, arrived = witness.tally(), np.hypot(*(world.pose[:, :2] - goals).T) <= 0.6
    nearest = witness.nearest()
    outcome = Outcome(
        robots=5,
        arrived=int(arrived.sum()),
        robot_events=int(counted.robot_events.sum()),
        obstacle_events=int(counted.obstacle_events.sum()),
        safe_start=True,
        simulated_s=steps * world.dt_s,
        mover_events=counted.mover_events,
        mover_hits=counted.mover_hits,
        pushed_events=counted.pushed_events,
        above_limits=counted.above_limits,
        pairs_touched=counted.pairs_touched,
        robots_touched=counted.robots_touched,
        separation_m=nearest["separation.min_m"].value,
        clearance_m=nearest["clearance.min_m"].value,
        time_to_contact_s=nearest["time_to_contact.min_s"].value,
    )
    found = Measurement(outcome, "time limit", truth=witness.values(), evidence=witness.evidence(), approaches=nearest)
    record = Record(
        id=trial_id(trial(seed)), experiment="audit", trial=trial(seed), outcome=outcome, end_reason="time limit",
        truth=dict(found.truth), approaches=dict(found.approaches),
    )  # fmt: skip
    return record, found


def stored(tmp_path: Path, record: Record, found: Measurement) -> Path:
    return write_trial(tmp_path, record, Provenance(), found)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=8, deadline=None)
def test_an_independent_recount_agrees_with_the_referee_in_random_worlds(
    seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    record, found = driven(seed, 120)
    audited = audit_trial(stored(tmp_path_factory.mktemp("out"), record, found))
    assert audited.differences == []
    assert audited.verdict == "agrees"
    assert audited.steps == 120
    assert audited.bound_m < 0.02


def test_the_random_worlds_have_contacts_of_all_kinds_and_commands_above_the_limits() -> None:
    outcomes = [record.outcome for record, _ in (driven(seed, 120) for seed in range(4))]
    for name in (
        "robot_events", "obstacle_events", "mover_events", "mover_hits", "pushed_events", "above_limits", "arrived",
    ):  # fmt: skip
        assert sum(getattr(each, name) for each in outcomes) > 0, name


def test_it_agrees_where_a_rigid_body_engine_pushes(tmp_path: Path) -> None:
    audited = audit_trial(stored(tmp_path, *driven(1, 100, "pybullet", movers=0)))
    assert (audited.verdict, audited.differences) == ("agrees", [])


@pytest.fixture(scope="module")
def crowded() -> tuple[Record, Measurement]:
    record, found = driven(6, 150)
    assert record.outcome is not None
    assert record.outcome.robot_events > 1
    assert record.outcome.obstacle_events > 0
    assert record.outcome.above_limits > 0
    return record, found


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("robot_events", -1),
        ("robot_events", 2),
        ("obstacle_events", -1),
        ("mover_events", 1),
        ("pairs_touched", -1),
        ("robots_touched", -1),
        ("above_limits", -1),
        ("arrived", 1),
        ("separation.min_m", 0.1),
        ("simulated_s", 0.5),
    ],
)
def test_an_edited_count_is_found_out(
    crowded: tuple[Record, Measurement], tmp_path: Path, name: str, change: float
) -> None:
    record, found = crowded
    folder = stored(tmp_path, record, found)
    document: dict[str, Any] = msgspec.json.decode((folder / RESULT_FILE).read_bytes())
    document["outcome"][{"separation.min_m": "separation_m"}.get(name, name)] += change
    (folder / RESULT_FILE).write_bytes(msgspec.json.encode(document))
    audited = audit_trial(folder)
    assert audited.verdict == "differs"
    assert any(each.startswith(name) for each in audited.differences)


def forged(folder: Path, found: Measurement, change: Callable[[Evidence], Evidence], resealed: bool) -> Audited:
    """Audit evidence that was changed, with or without a digest that fits the change."""
    assert found.evidence is not None
    evidence = change(found.evidence)
    save_arrays(evidence, folder / EVIDENCE_FILE)
    if resealed:
        document: dict[str, Any] = msgspec.json.decode((folder / PROVENANCE_FILE).read_bytes())
        document["evidence"] = digest_of(arrays_of(evidence))
        (folder / PROVENANCE_FILE).write_bytes(msgspec.json.encode(document))
    return audit_trial(folder)


def moved(evidence: Evidence) -> Evidence:
    """Put the first robot half a metre aside, for one step."""
    xy = evidence.xy.copy()
    xy[70, 0, 0] += 50_000
    xy[71, 0, 0] -= 50_000
    return replace(evidence, xy=xy)


def without_a_bend(evidence: Evidence) -> Evidence:
    """Leave out that somebody touched something, once."""
    return replace(
        evidence, bend_step=evidence.bend_step[1:], bend_robot=evidence.bend_robot[1:], bend=evidence.bend[1:]
    )


def slower(evidence: Evidence) -> Evidence:
    """Leave out one command above the limits."""
    return replace(evidence, above=evidence.above[1:])


def farther(evidence: Evidence) -> Evidence:
    """Say that two robots never came as near as they did."""
    closest = evidence.closest_m.copy()
    closest[closest.argmax()] += 0.1
    return replace(evidence, closest_m=closest)


@pytest.mark.parametrize("change", [moved, without_a_bend, slower, farther])
def test_changed_evidence_is_found_out_also_with_a_fitting_digest(
    crowded: tuple[Record, Measurement], tmp_path: Path, change: Callable[[Evidence], Evidence]
) -> None:
    folder = stored(tmp_path, *crowded)
    assert audit_trial(folder).verdict == "agrees"
    sealed = forged(folder, crowded[1], change, resealed=False)
    assert any("digest" in each for each in sealed.differences)
    assert forged(folder, crowded[1], change, resealed=True).verdict == "differs"


def test_a_pose_that_is_moved_by_a_grain_breaks_the_digest(
    crowded: tuple[Record, Measurement], tmp_path: Path
) -> None:  # fmt: skip
    def nudged(evidence: Evidence) -> Evidence:
        xy = evidence.xy.copy()
        xy[10, 0, 0] += 1
        return replace(evidence, xy=xy)

    folder = stored(tmp_path, *crowded)
    assert forged(folder, crowded[1], nudged, resealed=False).verdict == "differs"


def test_trials_without_motion_are_named_and_alone_they_are_no_success(
    crowded: tuple[Record, Measurement], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, found = crowded
    assert found.evidence is not None
    folder = stored(tmp_path, record, replace(found, evidence=found.evidence.kept("never")))
    assert audit_trial(folder).verdict == "no motion"
    with pytest.raises(ConfigError, match="nothing can be recounted"):
        audit(tmp_path, False, 1)
    assert "no motion" in capsys.readouterr().out
    (folder / EVIDENCE_FILE).unlink()
    assert audit_trial(folder).verdict == "no evidence"


def test_a_count_is_held_against_the_closest_approaches_also_without_motion(
    crowded: tuple[Record, Measurement], tmp_path: Path
) -> None:
    record, found = crowded
    assert found.evidence is not None
    assert record.outcome is not None
    clean = msgspec.structs.replace(record.outcome, robot_events=0, pairs_touched=0)
    folder = stored(
        tmp_path, msgspec.structs.replace(record, outcome=clean), replace(found, evidence=found.evidence.kept("never"))
    )
    assert audit_trial(folder).verdict == "differs"


def test_a_gap_between_poses_that_cannot_be_seen_is_undecided() -> None:
    """A robot on an arc passes another one: nearest between two poses, by less than the arc may be off its chord."""
    step_s, speed_m_s, turn_rad_s = 0.02, 4.0, 8.0
    radius_m = speed_m_s / turn_rad_s
    angles = turn_rad_s * step_s * (np.arange(-10, 10) + 0.5)
    arc = radius_m * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    sagitta_m = radius_m * (1.0 - math.cos(0.5 * turn_rad_s * step_s))
    touch_m = 0.002
    # On the arc the gap would be below the touching one, on the chord it is above.
    aside_m = radius_m + 0.34 + touch_m - 0.5 * sagitta_m
    motion = np.zeros((20, 2, 5))
    motion[:, 0, :2], motion[:, 1, :2], motion[:, 0, 2] = arc, (0.0, aside_m), -angles
    motion = np.diff(np.round(motion / 1e-5).astype(np.int32), axis=0, prepend=np.int32(0))
    none = np.zeros(0, np.int32)
    counted = recount(
        {
            "ids": np.array(["a", "b"]), "radius_m": np.array([0.17, 0.17]), "obstacles": np.zeros((0, 6)),
            "step_s": np.array(step_s), "touch_m": np.array(touch_m), "part_s": np.array([step_s]),
            "limits": np.full((2, 2), 10.0), "goals": np.zeros((2, 2)), "goal_radius_m": np.array(0.1),
            "xy": motion[:, :, :2], "heading": motion[:, :, 2], "command": motion[:, :, 3:],
            "mover_radius_m": np.zeros(0), "mover_xy": np.zeros((19, 0, 2), np.int32),
            "above": np.zeros((0, 4)), "bend_step": none, "bend_robot": none, "bend": np.zeros((0, 1, 2), np.int32),
        }
    )  # fmt: skip
    assert counted.undecided == 1
    assert counted.contradictions == []
    assert counted.robot_events.most == 0  # none is recorded
    assert counted.bound_m[0] == pytest.approx(sagitta_m, rel=0.05)


@pytest.mark.parametrize(
    ("end_s", "verdict"), [(2.0, ""), (1.0, ""), *((each, "all arrived") for each in (1.5, 2.5, 3.2))]
)
def test_that_all_arrived_is_held_against_when_they_were_there_for_long_enough_to_be_seen(
    end_s: float, verdict: str
) -> None:
    """A trial looks each 0.1 s: that all were at their goals for 0.06 s may escape it, for half a second it may not."""
    step_s = 0.02
    times_s = np.arange(1, 200) * step_s
    there = ((times_s >= 1.0) & (times_s < 1.06)) | ((times_s >= 2.0) & (times_s < 2.5)) | (times_s >= 3.2)
    place = np.where(there, 0.05, 0.2)
    motion = np.zeros((200, 1, 5))
    motion[1:, 0, 0], motion[0, 0, 0] = place, 0.2
    motion = np.diff(np.round(motion / 1e-5).astype(np.int32), axis=0, prepend=np.int32(0))
    none = np.zeros(0, np.int32)
    counted = recount(
        {
            "ids": np.array(["a"]), "radius_m": np.array([0.17]), "obstacles": np.zeros((0, 6)),
            "step_s": np.array(step_s), "touch_m": np.array(0.002), "part_s": np.array([step_s]),
            "limits": np.full((1, 2), 10.0), "goals": np.zeros((1, 2)), "goal_radius_m": np.array(0.1),
            "xy": motion[:, :, :2], "heading": motion[:, :, 2], "command": motion[:, :, 3:],
            "mover_radius_m": np.zeros(0), "mover_xy": np.zeros((199, 0, 2), np.int32),
            "above": np.zeros((0, 4)), "bend_step": none, "bend_robot": none, "bend": np.zeros((0, 1, 2), np.int32),
        }
    )  # fmt: skip
    assert [round(from_s, 3) for from_s, _ in counted.all_there_s] == [1.0, 2.0, 3.2]
    problem = "; ".join(arrival_problem(counted, end_s, slack_s=step_s))
    assert problem[: len("all arrived")] == verdict
