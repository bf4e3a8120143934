"""What a rollout's hands make of a robot's answers: no network, answers from a list."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import pytest

from fullswarm.deploy.fleet import robot_update
from fullswarm.deploy.fleet.facts import Agent, Facts, Health
from fullswarm.deploy.fleet.login import Address
from fullswarm.deploy.fleet.releases import Archives
from fullswarm.deploy.fleet.remote import Answer, Remote
from fullswarm.deploy.fleet.robot_update import RobotUpdater, SupportPackage, ship_release
from fullswarm.deploy.fleet.rollout import Outcome, Stage
from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.keys import Keys
from fullswarm.errors import FullswarmError
from tests.deploy_release import tiny_release

RELEASE = "1.0-0123456789ab"
RUNS = Agent(active=True, state="active/running")
DIES = Agent(state="activating/auto-restart", restarts=7)
WELL = Health(release=RELEASE, healthy=True)
LONELY = Health(release=RELEASE, why=["it receives neither the core nor another robot"])


@dataclass
class Robot:
    """Answers in turn, the last one for ever; notes what it was asked and fed."""

    answers: list[Answer]
    robot: str = "r1"
    own_key: bool = False
    asked: list[tuple[str, ...]] = field(default_factory=list)
    fed: list[object] = field(default_factory=list)

    async def program(self, *words: str, feed: object = b"", within_s: float | None = None) -> Answer:
        self.asked.append(words)
        self.fed.append(feed.read_bytes() if isinstance(feed, Path) else feed)
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]

    @property
    def remote(self) -> Remote:
        return cast(Remote, self)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("POLL_S", 0.001), ("SICK_S", 0.5), ("SILENT_S", 1.0)):
        monkeypatch.setattr(robot_update, name, value)


def hands(kits: dict[str, SupportPackage] | None = None) -> RobotUpdater:
    nothing = cast(Any, None)
    addresses = {"r1": Address("r1", "10.0.0.1", 22, "me")}
    return RobotUpdater(nothing, addresses, nothing, nothing, lambda _: None, "", packages=kits or {})


def says(monkeypatch: pytest.MonkeyPatch, facts: Iterable[Facts]) -> list[Facts]:
    """Let the robot's facts be these, one after the other, the last one for ever; return those that were asked for."""
    left, asked = list(facts), []

    async def facts_of(_: Remote) -> Facts:
        asked.append(left.pop(0) if len(left) > 1 else left[0])
        return asked[-1]

    monkeypatch.setattr(robot_update, "facts_of", facts_of)
    return asked


def of(agent: Agent, health: Health | None) -> Facts:
    return Facts(protocol=1, robot="r1", current=RELEASE, agent=agent, health=health)


def current(facts: Facts) -> Outcome:
    return asyncio.run(hands()._current(Robot([]).remote, facts, RELEASE))


# ---------------------------------------------------------------- it has the release: does it run?
def test_one_that_is_well_is_asked_nothing_more(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = says(monkeypatch, [of(RUNS, WELL)])
    outcome = current(of(RUNS, WELL))
    assert (outcome.stage, outcome.what) == (Stage.CURRENT, "runs it already; nothing was changed")
    assert asked == []


def test_one_without_a_core_has_its_release_and_says_what_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    says(monkeypatch, [of(RUNS, LONELY)])
    outcome = current(of(RUNS, LONELY))
    assert outcome.stage is Stage.CURRENT
    assert outcome.what.endswith("not healthy: it receives neither the core nor another robot")


def test_one_that_was_restarted_gets_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = says(monkeypatch, [of(RUNS, None), of(RUNS, LONELY), of(RUNS, WELL)])
    assert current(of(Agent(), None)).what == "runs it already; nothing was changed"
    assert len(asked) == 3


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        (of(DIES, None), "activating/auto-restart, restarted 7 times"),
        (of(Agent(), WELL), "not started"),
        (of(RUNS, None), "it reports no health"),
        (of(RUNS, Health(release="0.9-0123456789ab", healthy=True)), "it still runs 0.9-0123456789ab"),
    ],
)
def test_one_whose_agent_does_not_run_has_failed(monkeypatch: pytest.MonkeyPatch, facts: Facts, why: str) -> None:
    says(monkeypatch, [facts])
    with pytest.raises(FullswarmError, match="its agent does not run: ") as raised:
        current(facts)
    assert why in raised.value.what
    assert raised.value.hint == "`fullswarm logs r1`"


def test_one_that_starts_again_and_again_does_not_run(monkeypatch: pytest.MonkeyPatch) -> None:
    says(monkeypatch, [of(Agent(active=True, restarts=each), LONELY) for each in range(1, 500)])
    with pytest.raises(FullswarmError, match="its agent does not run"):
        current(of(RUNS, LONELY))


# ---------------------------------------------------------------- what it was given is there
def test_a_kit_that_did_not_arrive_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    says(monkeypatch, [Facts(protocol=1, kit="old")])
    task = hands({"r1": SupportPackage(b"", "new")})._install(
        Robot([Answer(0, b"", b"")]).remote, Facts(protocol=1, kit="old")
    )
    with pytest.raises(FullswarmError, match="its files differ"):
        asyncio.run(task)


@pytest.fixture
def release(tmp_path: Path) -> Path:
    return tiny_release(tmp_path / "store", Keys(tmp_path / "keys"), "1.0")


def stage(robot: Robot, release: Path, folder: Path) -> None:
    asyncio.run(ship_release(robot.remote, release, Archives(folder), Facts(protocol=1)))


def test_what_turns_out_to_be_damaged_there_is_shipped_once_more(release: Path, tmp_path: Path) -> None:
    path = sorted(manifest.read_sums(release))[0]
    good, lacks = Answer(0, b"", b""), Answer(1, f"{path}\n".encode(), b"")
    robot = Robot([good, lacks, good])
    stage(robot, release, tmp_path)
    assert [each[0] for each in robot.asked] == ["want", "receive", "receive"]
    assert robot.fed[1] != robot.fed[2]
    robot = Robot([good, lacks])
    with pytest.raises(FullswarmError, match="received the release incompletely"):
        stage(robot, release, tmp_path)
    assert len(robot.asked) == 3


def test_a_full_disk_of_ours_is_that_robots_failure_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    async def full(*_: object) -> Outcome:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RobotUpdater, "_stage", full)
    outcome = asyncio.run(hands()("r1", Stage.STAGING))
    assert (outcome.stage, outcome.exit_code) == (Stage.FAILED, 1)
    assert "this computer could not read or pack the release: No space left on device" in outcome.what
    assert "df -h" in outcome.mend
