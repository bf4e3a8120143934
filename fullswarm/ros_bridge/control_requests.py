"""Shows which behaviour each robot runs, on topics named as in the paper: ``<robot>/<behaviour>/control_requests``.

The paper's request handler sends a robot its control requests on such topics (II.D). Here they are only shown: what a
robot reports to run, with the parameters of the request if that was received. They are not taken from ROS, which asks
on ``swarm/request``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

from fullswarm.keys import ROBOT_ID
from fullswarm.messages import BehaviourRequest, Parameters, RobotHealth
from fullswarm.recent import Recent
from fullswarm.ros_bridge.codec import STRING
from fullswarm.ros_bridge.link import Topic, Values

REQUESTS = 256
"""Requests whose parameters are remembered."""
KEPT = 4
"""Topics of one robot: those of its newest behaviours."""


class SeenRequests:
    """The newest request of each sender, behaviour and set of robots: a stream of intents takes one place."""

    def __init__(self) -> None:
        self._requests: Recent[tuple[str, str, tuple[str, ...]], BehaviourRequest] = Recent(REQUESTS)

    def add(self, request: BehaviourRequest) -> None:
        """Remember a request."""
        self._requests[request.source, request.behaviour, request.robots] = request

    def parameters(self, request_id: str) -> Parameters:
        """Return what a request has set; empty: nothing, or it was not received."""
        found = (each.parameters for each in self._requests.values() if request_id and each.id == request_id)
        return next(found, {})


class ControlRequests:
    """What one robot runs, as its topics show it.

    Parameters
    ----------
    name
        The robot's, in ROS.
    advertise, withdraw, publish
        Offer a topic, offer it no more, send on it.
    """

    def __init__(
        self,
        name: str,
        advertise: Callable[[Topic], None],
        withdraw: Callable[[Topic], None],
        publish: Callable[[Topic, Values], None],
    ) -> None:
        self._name, self._advertise, self._withdraw, self._publish = name, advertise, withdraw, publish
        self._topics: dict[str, Topic] = {}  # by behaviour, the newest last
        self._running = "", ""  # behaviour, request

    def update(self, health: RobotHealth, requests: SeenRequests) -> None:
        """Show what the robot runs now, if it is something else than before."""
        if health.behaviour and not ROBOT_ID.match(health.behaviour):  # it would become a part of a key
            return
        now = health.behaviour, health.request_id
        before, self._running = self._running, now
        if now == before:
            return
        if before[0] and before[0] != now[0]:
            self._show(*before, enable=False, parameters={})
        if now[0]:
            self._show(*now, enable=True, parameters=requests.parameters(now[1]))

    def _show(self, behaviour: str, request_id: str, *, enable: bool, parameters: Mapping[str, object]) -> None:
        topic = self._topics.pop(behaviour, None)
        if topic is None:
            topic = Topic(f"{self._name}/{behaviour.replace('-', '_')}/control_requests", STRING, latched=True)
            self._advertise(topic)
        self._topics[behaviour] = topic
        while len(self._topics) > KEPT:
            self._withdraw(self._topics.pop(next(iter(self._topics))))
        text = {"behaviour": behaviour, "request_id": request_id, "enable": enable, "parameters": parameters}
        self._publish(topic, {"data": json.dumps(text, ensure_ascii=False)})

    def close(self) -> None:
        """Offer nothing more."""
        for topic in self._topics.values():
            self._withdraw(topic)
        self._topics.clear()
