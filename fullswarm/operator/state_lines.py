"""Tells changes of a swarm's state as lines of text, for a pipe or a file: `fullswarm watch | tee run.log`."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

from fullswarm.clock import wall_time_s
from fullswarm.operator.robot_state import row_state
from fullswarm.operator.view import SILENT_S, RobotRow, Snapshot
from fullswarm.output import one_line

LEAST_S = 1.0
"""Between two lines about the same robot."""


class StateLines:
    """Prints a line for each robot and process at first, and when its state has changed.

    Parameters
    ----------
    say : prints a line
    wall_s : seconds since 1970, for the time of day that each line begins with
    """

    def __init__(self, say: Callable[[str], None], wall_s: Callable[[], float] = wall_time_s) -> None:
        self._say, self._wall_s = say, wall_s
        self._shown: dict[str, tuple[str, float]] = {}

    def look(self, seen: Snapshot) -> None:
        """Print what has changed since the last look."""
        now_s = self._wall_s()
        at = datetime.fromtimestamp(now_s).astimezone().strftime("%H:%M:%S")
        rows = {"hub": "connected" if seen.connected else "LOST"}
        rows |= {node.node: "alive" if node.age_s <= SILENT_S else "SILENT" for node in seen.nodes}
        rows |= {f"process {each.state.name}": each.state.phase for each in seen.processes if each.text}
        rows |= dict.fromkeys(seen.missing, "MISSING, not reporting")
        texts = {name: (state, state) for name, state in rows.items()}
        texts |= {row.robot: (_state(row), _line(row)) for row in seen.robots}
        for name, (state, line) in texts.items():
            before, said_s = self._shown.get(name, ("", now_s - LEAST_S))
            if state != before and now_s - said_s >= LEAST_S:
                self._shown[name] = state, now_s
                self._say(one_line(f"{at} {name}: {line}"))
        for name in self._shown.keys() - texts.keys():
            del self._shown[name]


def _state(row: RobotRow) -> str:
    """Return what counts as a state: a robot's silence grows each second, and is one state."""
    state = row_state(row)
    behaviour = row.health.behaviour if row.health else ""
    return f"{behaviour} {'SILENT' if row.silent else state.text}"


def _line(row: RobotRow) -> str:
    health = row.health
    behaviour = (health.behaviour if health else "") or "no behaviour"
    battery = f", battery {health.battery:.0%}" if health and health.battery >= 0.0 else ""
    return f"{row_state(row).text}, {behaviour}, at x {row.x_m:.2f} y {row.y_m:.2f} m{battery}"
