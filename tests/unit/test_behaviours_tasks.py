"""Auction, pattern, patrol and exploration: against optima, properties of their papers, and lost robots."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw

from fullswarm import Lab
from fullswarm.agent.behaviours import exploration, pattern, task_auction
from fullswarm.cli.values import parse_value
from fullswarm.errors import ConfigError
from fullswarm.evaluate.pictures.ink import MOST, dark_points
from fullswarm.kernels import Array, Flags

from .points import Points

AUCTION: dict[str, Any] = {"service_s": 1.0, "silent_s": 4.0, "speed_m_s": 0.5}


# ------------------------------------------------------------------ auction
@pytest.mark.parametrize("seed", range(4))
def test_bids_settle_on_the_greedy_allocation_whose_worth_is_half_the_optimum_at_least(seed: int) -> None:
    """Over a chain of robots each of which receives the next ones only."""
    rng = np.random.default_rng(seed)
    robots = np.sort(rng.uniform(0.0, 10.0, (5, 2)), axis=0)
    tasks = rng.uniform(0.0, 10.0, (5, 2))
    points = Points(
        task_auction, robots, {**AUCTION, "tasks": tasks.tolist(), "speed_m_s": 1e-9}, reach_m=7.0, dt_s=0.1
    )
    points.step(40)
    taken = points.memory.task.tolist()
    assert sorted(taken) == list(range(5))
    apart = np.linalg.norm(robots[:, None] - tasks, axis=2)
    left, greedy = apart.copy(), [-1] * 5
    for _ in range(5):
        robot, task = np.unravel_index(left.argmin(), left.shape)
        greedy[int(robot)] = int(task)
        left[robot], left[:, task] = np.inf, np.inf
    assert taken == greedy
    worth = 15.0 - apart
    best = max(worth[range(5), list(order)].sum() for order in itertools.permutations(range(5)))
    assert worth[range(5), taken].sum() >= 0.5 * best


def test_all_tasks_are_done_once_and_those_of_a_lost_robot_by_the_others() -> None:
    rng = np.random.default_rng(7)
    tasks = rng.uniform(0.0, 8.0, (7, 2))
    points = Points(task_auction, rng.uniform(0.0, 8.0, (3, 2)), {**AUCTION, "tasks": tasks.tolist()}, dt_s=0.05)
    points.step(20)
    claimed = int(points.memory.task[1])
    points.lost = [1]
    visits: list[tuple[int, int]] = []
    for _ in range(2500):
        before = points.memory.task.copy()
        points.step()
        at_m = np.linalg.norm(points.position - tasks[before], axis=1)  # a robot that is outbid is not there
        ready = np.flatnonzero((before >= 0) & (points.memory.task < 0) & (at_m < 0.2))
        visits += [(row, int(before[row])) for row in ready.tolist()]
        if {0, 2} <= points.ended.keys():
            break
    assert points.ended[0] == points.ended[2] == "all tasks are done"
    done = [task for _, task in visits]
    assert sorted(done) == list(range(7))
    assert claimed in done


def test_an_auction_on_robots_with_a_bad_network_serves_every_task() -> None:
    starts = [[1.5, 1.5, 0.0], [6.5, 1.5, 2.0], [4.0, 4.0, 1.0]]
    tasks = [[1.0, 6.0], [6.5, 6.0], [4.0, 1.0], [1.2, 3.5]]
    settings = {"network.conditions": "loss=30%,delay=30ms±20", "world.noise.position_m": 0.01}
    nearest = np.full(len(tasks), np.inf)
    with Lab(starts=starts, bounds=(0, 0, 8, 7), settings=settings) as lab:
        request = lab.request("task_auction_bc", tasks=tasks, service_s=1.0)
        for _ in range(60):
            lab.run(1.0)
            nearest = np.minimum(nearest, np.linalg.norm(lab.poses[:, None, :2] - tasks, axis=2).min(axis=0))
            assert (lab.contacts == 0).all()
            if not request.running:
                break
        assert request.status is not None
        assert {each.text for each in request.status.results} == {"all tasks are done"}
    assert nearest.max() < 0.25


def test_a_task_that_is_claimed_late_is_not_taken_from_its_robot() -> None:
    """Robot 0 is free for the second task at about 12 s, longer than `silent_s` after the start."""
    starts, tasks = np.array([[0.0, 0.0], [9.0, 0.0]]), [[1.0, 0.0], [8.0, 0.0], [0.0, 1.0], [3.0, 3.0]]
    points = Points(task_auction, starts, {**AUCTION, "tasks": tasks, "service_s": 10.0}, dt_s=0.05)
    claims: list[tuple[int, int]] = []
    for _ in range(1200):
        before = points.memory.task.copy()
        points.step()
        changed = (points.memory.task != before) & (points.memory.task >= 0)
        claims += [(row, int(points.memory.task[row])) for row in np.flatnonzero(changed).tolist()]
        if len(points.ended) == 2:
            break
    late = [task for _, task in claims if task in (2, 3)]
    assert sorted(late) == [2, 3]  # each was claimed once
    assert points.time_s < 10.0 * 2 + 25.0


def test_too_many_tasks_are_refused() -> None:
    points = Points(task_auction, np.zeros((1, 2)), {**AUCTION, "tasks": [[float(k), 0.0] for k in range(64)]})
    with pytest.raises(ConfigError, match="64 tasks are too many"):
        points.step()


# ------------------------------------------------------------------ pattern
def heart(path: Path) -> Path:
    picture = Image.new("L", (200, 180), 255)
    draw = ImageDraw.Draw(picture)
    draw.ellipse((20, 20, 100, 100), fill=0)
    draw.ellipse((100, 20, 180, 100), fill=0)
    draw.polygon([(25, 75), (175, 75), (100, 165)], fill=0)
    picture.save(path)
    return path


def test_the_dark_parts_of_a_picture_become_points(tmp_path: Path) -> None:
    points = np.array(dark_points(heart(tmp_path / "heart.png")))
    assert 100 < len(points) <= MOST
    assert points.min() > 0.05
    assert points[:, 0].max() < 0.95
    with Image.open(tmp_path / "heart.png") as picture:
        pixels = np.asarray(picture)
    inked = [pixels[int(180 - 200 * y), int(200 * x)] == 0 for x, y in points]
    assert np.mean(inked) > 0.95  # upright, and not mirrored
    assert parse_value(f"@{tmp_path / 'heart.png'}") == points.tolist()
    assert parse_value("@east") == "@east"


def test_files_that_are_no_picture_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no picture")
    Image.new("L", (9, 9), 255).save(tmp_path / "white.png")
    for name, text in (("none.png", "no such file"), ("text.png", "can be read"), ("white.png", "nothing .* is dark")):
        with pytest.raises(ConfigError, match=text):
            dark_points(tmp_path / name)


@pytest.mark.parametrize("count", [1, 5, 24])
def test_places_are_different_inside_the_picture_and_spread(tmp_path: Path, count: int) -> None:
    ink = dark_points(heart(tmp_path / "heart.png"))
    found = pattern.places(tuple(map(tuple, ink)), count)
    assert len(found) == count
    unit = np.array(ink) - 0.5 * (np.min(ink, axis=0) + np.max(ink, axis=0))
    unit /= np.ptp(np.array(ink), axis=0).max()
    assert np.linalg.norm(found[:, None] - unit, axis=2).min(axis=1).max() < 0.08
    apart = np.linalg.norm(found[:, None] - found, axis=2) + np.eye(count)
    assert apart.min() > 0.5 * math.sqrt(0.55 / count)  # the heart covers about half of its square


def test_robots_fill_a_picture_without_two_in_one_place(tmp_path: Path) -> None:
    centre, width = [4.0, 4.0], 5.0
    with Lab(robots=9, bounds=(0, 0, 8, 8), seed=4, settings={"world.noise.position_m": 0.01}) as lab:
        lab.request("pattern_bc", picture=heart(tmp_path / "heart.png"), centre=centre, width_m=width)
        for _ in range(8):
            lab.run(5.0)
            assert (lab.contacts == 0).all()
        at = lab.poses[:, :2]
    ink = tuple(map(tuple, dark_points(tmp_path / "heart.png")))
    places = np.array(centre) + width * pattern.places(ink, 9)
    apart = np.linalg.norm(at[:, None] - places, axis=2)
    assert sorted(apart.argmin(axis=1)) == list(range(9))
    assert apart.min(axis=1).max() < 0.15


# ------------------------------------------------------------------ patrol
PLACES = [[1.0, 1.0], [7.0, 1.0], [7.0, 5.0], [4.0, 5.0], [1.0, 5.0]]
TOUR_M = 6.0 + 4.0 + 3.0 + 3.0 + 4.0


@pytest.mark.parametrize("robots", [1, 3])
def test_no_place_waits_much_longer_than_a_tour_of_all_divided_by_the_robots(robots: int) -> None:
    starts = [[2.0, 2.5, 0.0], [4.0, 2.5, 1.0], [6.0, 2.5, 2.0]][:robots]
    last, longest = np.zeros(len(PLACES)), np.zeros(len(PLACES))
    with Lab(starts=starts, bounds=(0, 0, 8, 6), seed=robots) as lab:
        lab.request("patrol_bc", places=PLACES, speed_m_s=0.4)
        while lab.time_s < 180.0:
            lab.run(0.5)
            near = np.linalg.norm(lab.poses[:, None, :2] - PLACES, axis=2).min(axis=0) < 0.35
            last[near] = lab.time_s
            if lab.time_s > 50.0:
                longest = np.maximum(longest, lab.time_s - last)
        assert (lab.contacts == 0).all()
    assert longest.max() < 2.0 * TOUR_M / (0.4 * robots)


# ------------------------------------------------------------------ exploration
WALLS = [(4.0, 1.5, 0.2, 3.0), (4.0, 6.5, 0.2, 3.0), (6.0, 4.0, 1.0, 1.0)]


@pytest.mark.parametrize("behaviour", ["exploration_bc", "exploration"])
def test_all_that_can_be_reached_is_seen_and_then_the_robots_end(behaviour: str) -> None:
    seen = np.zeros((40, 40), bool)
    x, y = np.meshgrid(np.arange(0.1, 8.0, 0.2), np.arange(0.1, 8.0, 0.2))
    cells = np.column_stack([x.ravel(), y.ravel()])
    with Lab(starts=[[1.0, 1.0, 0.0], [1.0, 2.0, 0.0]], bounds=(0, 0, 8, 8), obstacles=WALLS) as lab:
        request = lab.request(behaviour, sight_m=1.8)
        while lab.time_s < 240.0 and request.running:
            lab.run(1.0)
            for place in lab.poses[:, :2]:
                seen |= in_sight(place, cells).reshape(seen.shape)
            assert behaviour == "exploration" or (lab.contacts == 0).all()
        assert request.status is not None
        assert {each.outcome for each in request.status.results} == {"arrived"}
    free = ~np.array([inside(cell) for cell in cells]).reshape(seen.shape)
    assert seen[free].mean() > 0.99


def inside(point: Array) -> bool:
    return any(abs(point[0] - x) <= w / 2 + 0.1 and abs(point[1] - y) <= h / 2 + 0.1 for x, y, w, h in WALLS)


def in_sight(place: Array, cells: Array) -> Flags:
    """Tell which cells are within 2 m with no wall between, by small steps."""
    steps = place + np.linspace(0.0, 1.0, 30)[:, None, None] * (cells - place)
    clear = np.linalg.norm(cells - place, axis=1) < 2.0
    for x, y, w, h in WALLS:
        clear &= ~((np.abs(steps[..., 0] - x) < w / 2) & (np.abs(steps[..., 1] - y) < h / 2)).any(axis=0)
    seen: Flags = clear
    return seen


def test_ways_over_cells_are_shortest() -> None:
    free = np.ones((exploration.SIDE, exploration.SIDE), bool)
    free[:40, 20] = False
    cell, low = np.array([0.5, 0.5]), np.zeros(2)
    ways = exploration.ways_from(np.array([0.25, 0.25]), cell, low, free)
    assert ways[0, 19] == pytest.approx(19 * 0.5)
    assert ways[10, 4] == pytest.approx(0.5 * (4 * 2**0.5 + 6))
    assert ways[0, 21] > 2 * 39 * 0.5  # around the wall
    assert np.isinf(ways[5, 20])


def test_maps_are_joined_from_broadcasts() -> None:
    places = np.array([[1.0, 1.0], [11.0, 1.0]])
    points = Points(
        exploration, places, {"sight_m": 2.0, "speed_m_s": 1e-6, "arrive_radius_m": 0.05, "gain": 1.0, "map": "own"},
        dt_s=0.1, bounds=(0.0, 0.0, 12.0, 12.0),
    )  # fmt: skip
    points.step(8)
    seen = points.memory.seen
    assert (seen[0] == seen[1]).all()
    assert seen[0, 4, 4] and seen[0, 4, 44] and not seen[0, 4, 24]  # noqa: PT018
