from __future__ import annotations

from dataclasses import replace

from fullswarm.messages import RobotHealth
from fullswarm.operator.state_lines import StateLines
from fullswarm.operator.view import RobotRow, Snapshot

HEALTH = RobotHealth(robot="r1", driver="d", make="m", model="m", firmware="", lifecycle="READY", battery=0.8)
ROW = RobotRow("r1", 0.1, 1.0, 2.0, 0.0, 0.0, HEALTH)
SEEN = Snapshot("lab", connected=True, robots=(ROW,))


def test_a_pipe_gets_a_line_at_first_and_at_each_change() -> None:
    lines, now_s = list[str](), [1000.0]
    told = StateLines(lambda line: lines.append(line.partition(" ")[2]), lambda: now_s[0])

    def look(seen: Snapshot) -> None:
        now_s[0] += 0.25
        told.look(seen)

    for _ in range(20):
        look(SEEN)
        look(replace(SEEN, robots=(replace(ROW, x_m=3.0),)))
    assert lines == ["hub: connected", "r1: standing, no behaviour, at x 1.00 y 2.00 m, battery 80%"]
    for age_s in range(2, 9):  # a silence that grows is one state
        for _ in range(4):
            look(replace(SEEN, robots=(replace(ROW, age_s=float(age_s)),)))
    assert [line[:20] for line in lines[2:]] == ["r1: SILENT for 2 s, "]
    look(replace(SEEN, connected=False, missing=("r2",)))
    assert set(lines[3:]) >= {"hub: LOST", "r2: MISSING, not reporting"}


def test_a_state_that_flickers_gets_a_line_a_second_at_most() -> None:
    lines, now_s = list[str](), [1000.0]
    told = StateLines(lines.append, lambda: now_s[0])
    moving = replace(
        ROW, health=RobotHealth(**{**{f: getattr(HEALTH, f) for f in HEALTH.__struct_fields__}, "moving": True})
    )
    for number in range(40):
        now_s[0] += 0.25
        told.look(replace(SEEN, robots=(moving if number % 2 else ROW,)))
    assert 5 <= sum(" r1: " in line for line in lines) <= 11
