"""Names that other processes invent are bounded, and forgotten; those of the fleet file are not."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.neighbours.estimates import Assumed, Neighbours
from fullswarm.messages import RobotStates
from fullswarm.recent import FORGET_S, Names


def states(robot: str, sequence: int = 1, x_m: float = 1.0) -> RobotStates:
    return RobotStates(
        host=robot, sequence=sequence, stamp_s=float(sequence), robots=(robot,), x_m=(x_m,), y_m=(2.0,),
        heading_rad=(0.0,), speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.1,), teams=(7,), sigma_m=(0.5,),
    )  # fmt: skip


def test_an_invented_name_is_forgotten_soon_and_one_that_was_there_for_long_is_not() -> None:
    gone: list[str] = []
    names = Names(10, gone.append, ["listed"])
    for now_s in range(60):
        assert names.admit("robot", float(now_s))
    assert names.admit("ghost", 60.0)
    assert names.admit("listed", 60.0)
    names.sweep(60.0 + FORGET_S)
    assert gone == []
    names.sweep(60.1 + FORGET_S)
    assert gone == ["ghost"]
    names.sweep(600.0)
    assert gone == ["ghost"]
    names.sweep(59.0 + 591.0)
    assert gone == ["ghost", "robot"]
    assert len(names) == 0
    assert names.admit("listed", 1e6)


def test_a_new_name_takes_the_place_of_the_one_that_was_silent_for_longest() -> None:
    gone: list[str] = []
    names = Names(2, gone.append)
    assert names.admit("a", 0.0)
    assert names.admit("b", 0.5)
    assert not names.admit("c", 0.9)  # all are there
    assert names.refused == 1
    assert names.admit("a", 1.0)
    assert names.admit("c", 1.6)
    assert gone == ["b"]


def test_ghosts_do_not_fill_the_table_of_neighbours_and_a_real_robot_stays() -> None:
    table = Neighbours(("me",), 1.0, Assumed(2.0, 0.5, 4.0, 1.3), listed=("me", "r2"))
    rows: list[int] = []
    table.on_forget.append(rows.append)
    table.receive(states("r2", x_m=3.0), 0.0)
    for number in range(5000):  # a thousand a second
        table.receive(states(f"ghost{number}"), number / 1000.0)
    assert table.count <= 257
    assert len(table.states) <= 512
    assert table.row_of("r2") == 0
    table.forget(100.0, lambda *_: True)
    assert len(rows) >= 256
    table.set_time(100.0)
    table.refresh(100.0)
    assert np.isnan(table.places[1 : table.count]).all()  # no ghost is in anyone's way
    assert table.places[0, 0] == 3.0  # what fell silent is


def test_nothing_is_left_of_a_robot_whose_row_another_one_gets() -> None:
    table = Neighbours(("me",), 1.0, Assumed(2.0, 0.5, 4.0, 1.3), listed=("me",))
    table.receive(states("ghost"), 0.0)
    row = table.row_of("ghost")
    table.forget(10.0, lambda *_: True)
    assert table.row_of("ghost") == -1
    plain = RobotStates(
        host="new", sequence=1, stamp_s=1.0, robots=("new",), x_m=(4.0,), y_m=(2.0,), heading_rad=(0.0,),
        speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.1,),
    )  # fmt: skip
    table.receive(plain, 10.0)
    assert table.row_of("new") == row
    assert table.names[row] == "new"
    assert table.teams[row] == 0
    assert table.sigma[row, 0] == 0.0
    assert math.isnan(table.limits[row, 0])
