"""Where each robot shall go, as far as its behaviour has a place to go to."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from fullswarm.messages import BehaviourRequest

REMEMBERED = 64
_GOALS = ("goal", "centre")
_RADIUS = "arrive_radius_m"


class Goals:
    """Puts together what the core wants of the robots and what the operators asked for.

    The core's orders are complete and are there after a start in mid-run. Only a centralised behaviour keeps its
    parameters elsewhere: then the request says them, if it was heard.
    """

    def __init__(self) -> None:
        self._asked: OrderedDict[str, BehaviourRequest] = OrderedDict()

    def heard(self, request: BehaviourRequest) -> None:
        """Remember a request."""
        self._asked[request.id] = request
        while len(self._asked) > REMEMBERED:
            self._asked.popitem(last=False)

    def shown(self, wanted: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        """Return robot → its goal, of those that have one."""
        found = {}
        for robot, order in wanted.items():
            request_id = str(order.get("request_id", ""))
            asked = self._asked.get(request_id)
            own = order.get("parameters")
            parameters = {**(asked.parameters if asked else {}), **(own if isinstance(own, dict) else {})}
            goal = next((point for name in _GOALS if (point := _point(parameters.get(name)))), None)
            target = _point(parameters.get("target"))
            if goal is None and target is None:
                continue
            radius = parameters.get(_RADIUS)
            found[robot] = {
                "behaviour": order.get("behaviour", ""),
                "request_id": request_id,
                "goal": goal,
                "target": target,
                "radius_m": radius if isinstance(radius, int | float) else None,
            }
        return found


def _point(value: object) -> list[float] | None:
    if isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(each, int | float) for each in value):
        return [float(each) for each in value]
    return None
