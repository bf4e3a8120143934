"""Every key expression of the bus. ``*`` stands for one chunk, ``**`` for any number of them.

======================================================  =====================  ===========================
key                                                     message                way
======================================================  =====================  ===========================
``<swarm>/behaviour/request``                           BehaviourRequest       operator → main controller
``<swarm>/behaviour/status``                            RequestStatus          core → all
``<swarm>/behaviour/<name>/control_request``            CentralisedRequest     main controller → its node
``<swarm>/behaviour/<name>/commands``                   CentralisedCommands    its node → request handler
``<swarm>/robot/<id>/behaviour/<name>/control_requests``  ControlRequest       request handler → agent
``<swarm>/robot/<id>/ack``                              ControlAck             agent → request handler
``<swarm>/robot/<id>/command``                          Command                request handler → agent
``<swarm>/robot/<id>/charge``                           ChargeOrder            core → agent
``<swarm>/charging/status``                             ChargingStatus         core → all
``<swarm>/robot/<id>/pose_fix``                         PoseFix                motion capture, world → agent
``<swarm>/robot/<id>/range_fix``                        RangeFix               radio anchors → agent
``<swarm>/fix_source/<name>``                           FixSourceReport        sources of fixes → agents, operators
``<swarm>/object/<name>``                               ObjectFix              motion capture → agents
``<swarm>/world/hold``                                  WorldHold              study → world
``<swarm>/world/poses``                                 TruePoses              world → simulated camera
``<swarm>/camera/<name>``                               CameraPicture          camera → console
``<swarm>/state/<cell>/<host>``                         RobotStates            agent → neighbours, core
``<swarm>/broadcast/<cell>/<host>``                     BehaviourBroadcast     agent → neighbours
``<swarm>/profile/<cell>/<host>``                       RobotProfiles          agent → neighbours, core
``<swarm>/report/query``                                ReportQuery            operators, core → all others
``<swarm>/reception/<host>``                            Reception              agent → core
``<swarm>/relay/<host>``                                RelayedStates          core → agent
``<swarm>/searched/<host>``                             SearchedDiscs          agent → agents
``<swarm>/obstacles/<host>``                            SeenObstacles          agent → agents
``<swarm>/grid/<host>``                                 GridTiles              agent → agents, operators
``<swarm>/range/query``                                 RangeQuery             operators → agents
``<swarm>/range/report/<id>``                           RangeReport            agent → operators
``<swarm>/health/<host>``                               HealthReport           agent → all
``<swarm>/heartbeat/<node>``                            Heartbeat              core, centralised nodes
``<swarm>/clock/<host>/probe``                          ClockProbe             agent → core
``<swarm>/clock/<host>/reply``                          ClockReply             core → agent
``<swarm>/version/<process>``                           Version                agents, core, world → all
``<swarm>/lease/request``                               LeaseRequest           operator → core
``<swarm>/lease/holders``                               Leases                 core → all
``<swarm>/roster``                                      KnownRobots            core → all
``<swarm>/mission/request``                             MissionRequest         operator → core
``<swarm>/mission/reply/<id>``                          MissionReply           core → the asker
``<swarm>/mission/status``                              MissionStatus          core → all
``<swarm>/memory/<host>``                               BehaviourMemory        agent → operators, trials
``<swarm>/actuators/<host>``                            ActuatorReport         agent → operators
``<swarm>/reload/<host>``                               FileReload             agent, core → operators
``<swarm>/processes/<host>``                            ProcessReport          supervisor → operators
``<swarm>/intervention/<host>``                         Interventions          agent → operators
``<swarm>/stop``                                        StopRequest            any → agents, core
``<swarm>/estop``                                       EStop                  any → agents, core
``<swarm>/estop/receipt/<id>``                          EStopReceipt           agent → all
``<swarm>/robot/<id>/ping``                             Ping                   any → agent
``<swarm>/robot/<id>/pong``                             Ping                   agent → any
``<swarm>/measurement/<metric>/<host>``                 …Measurement           calculator → summarizer
``<swarm>/summary/<metric>``                            Summary                summarizer → performance node
``<swarm>/identity/<name>/renew``                       CertificateRequest     any → core
``<swarm>/identity/<name>/certificate``                 CertificateReply       core → the asker
``<swarm>/params/<layer>/request``                      ParamRequest           any → a layer's database
``<swarm>/params/<layer>/reply/<id>``                   ParamReply             the database → the asker
``<swarm>/params/<layer>/changed``                      ParamChanged           the database → all
======================================================  =====================  ===========================
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from fullswarm.errors import ConfigError

ANY = "*"

ROBOT_ID = re.compile(r"[A-Za-z0-9_-]{1,64}\Z")
"""What a robot id, a swarm name or a behaviour name may look like: one plain chunk of a key."""

TRUTH = "truth"
"""The host of a supervisory process that measures the true bodies (paper II.F.1); no robot may be called so."""


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one swarm; several swarms share a network without receiving each other's messages."""

    swarm: str = "swarm"

    def __post_init__(self) -> None:
        if not ROBOT_ID.match(self.swarm):
            raise ConfigError(
                f"'{self.swarm}' cannot name a swarm", hint="use letters, digits, '-' and '_', 64 at most"
            )

    @property
    def behaviour_request(self) -> str:
        """Requests of the operators."""
        return f"{self.swarm}/behaviour/request"

    @property
    def behaviour_status(self) -> str:
        """The status of each request."""
        return f"{self.swarm}/behaviour/status"

    def centralised_request(self, behaviour: str = ANY) -> str:
        """Requests for the node of a centralised behaviour."""
        return f"{self.swarm}/behaviour/{behaviour}/control_request"

    def centralised_commands(self, behaviour: str = ANY) -> str:
        """Commands that such a node computed."""
        return f"{self.swarm}/behaviour/{behaviour}/commands"

    def control_requests(self, robot: str = ANY, behaviour: str = ANY) -> str:
        """Enable or disable a behaviour of a robot."""
        return f"{self.swarm}/robot/{robot}/behaviour/{behaviour}/control_requests"

    def ack(self, robot: str = ANY) -> str:
        """A robot's answers to control requests."""
        return f"{self.swarm}/robot/{robot}/ack"

    def command(self, robot: str = ANY) -> str:
        """Explicit twists for a robot."""
        return f"{self.swarm}/robot/{robot}/command"

    def charge(self, robot: str = ANY) -> str:
        """Interrupts a robot's task so that it charges."""
        return f"{self.swarm}/robot/{robot}/charge"

    @property
    def charging_status(self) -> str:
        """The state of the docks."""
        return f"{self.swarm}/charging/status"

    def pose_fix(self, robot: str = ANY) -> str:
        """Where something outside sees a robot."""
        return f"{self.swarm}/robot/{robot}/pose_fix"

    def range_fix(self, robot: str = ANY) -> str:
        """How far a robot is from an anchor."""
        return f"{self.swarm}/robot/{robot}/range_fix"

    def fix_source(self, name: str = ANY) -> str:
        """What a source of fixes sees and what it does not."""
        return f"{self.swarm}/fix_source/{name}"

    def object_fix(self, name: str = ANY) -> str:
        """Where something outside sees an object that is no robot."""
        return f"{self.swarm}/object/{name}"

    @property
    def world_hold(self) -> str:
        """Holds the simulated world still."""
        return f"{self.swarm}/world/hold"

    @property
    def true_poses(self) -> str:
        """Where the bodies of the simulated world are."""
        return f"{self.swarm}/world/poses"

    def camera(self, name: str = ANY) -> str:
        """Pictures of a camera."""
        return f"{self.swarm}/camera/{name}"

    def state(self, cell: str = ANY, host: str = ANY) -> str:
        """Kinematic states, by grid cell, so that a robot subscribes to its surroundings only."""
        return f"{self.swarm}/state/{cell}/{host}"

    def broadcast(self, cell: str = ANY, host: str = ANY) -> str:
        """What behaviours broadcast to neighbours, by grid cell as the states."""
        return f"{self.swarm}/broadcast/{cell}/{host}"

    def profile(self, cell: str = ANY, host: str = ANY) -> str:
        """What robots are and can do, by grid cell as the states."""
        return f"{self.swarm}/profile/{cell}/{host}"

    @property
    def report_query(self) -> str:
        """Asks all processes to publish now what they publish seldom."""
        return f"{self.swarm}/report/query"

    def reception(self, host: str = ANY) -> str:
        """Whose states a host receives."""
        return f"{self.swarm}/reception/{host}"

    def relay(self, host: str = ANY) -> str:
        """States of others that a host does not receive directly."""
        return f"{self.swarm}/relay/{host}"

    def searched(self, host: str = ANY) -> str:
        """Where silent robots can still be, as the robots of a host have seen."""
        return f"{self.swarm}/searched/{host}"

    def grid(self, host: str = ANY) -> str:
        """Tiles of the occupancy grid that the robots of a host have measured."""
        return f"{self.swarm}/grid/{host}"

    @property
    def range_query(self) -> str:
        """Asks robots for the scans of their range sensors."""
        return f"{self.swarm}/range/query"

    def range_report(self, robot: str = ANY) -> str:
        """The newest scans of a robot, while there is a query for it."""
        return f"{self.swarm}/range/report/{robot}"

    def obstacles(self, host: str = ANY) -> str:
        """Static obstacles that the robots of a host have seen."""
        return f"{self.swarm}/obstacles/{host}"

    def health(self, host: str = ANY) -> str:
        """How the robots of a host are."""
        return f"{self.swarm}/health/{host}"

    def heartbeat(self, node: str = ANY) -> str:
        """Signs of life of the core's processes."""
        return f"{self.swarm}/heartbeat/{node}"

    def clock_probe(self, host: str = ANY) -> str:
        """Asks the core for its time."""
        return f"{self.swarm}/clock/{host}/probe"

    def clock_reply(self, host: str = ANY) -> str:
        """The core's time."""
        return f"{self.swarm}/clock/{host}/reply"

    def version(self, process: str = ANY) -> str:
        """Which versions of messages a process speaks."""
        return f"{self.swarm}/version/{process}"

    @property
    def lease_request(self) -> str:
        """Requests of operators for the authority over robots."""
        return f"{self.swarm}/lease/request"

    @property
    def leases(self) -> str:
        """The present leases of all robots."""
        return f"{self.swarm}/lease/holders"

    @property
    def known_robots(self) -> str:
        """Which robots the core knows, and which of them report."""
        return f"{self.swarm}/roster"

    @property
    def mission_request(self) -> str:
        """Requests of operators to start and control missions."""
        return f"{self.swarm}/mission/request"

    def mission_reply(self, request_id: str = ANY) -> str:
        """The core's answers to them."""
        return f"{self.swarm}/mission/reply/{request_id}"

    @property
    def mission_status(self) -> str:
        """The state of each mission."""
        return f"{self.swarm}/mission/status"

    def memory(self, host: str = ANY) -> str:
        """What control laws remember."""
        return f"{self.swarm}/memory/{host}"

    def actuators(self, host: str = ANY) -> str:
        """What was asked of the actuators of robots."""
        return f"{self.swarm}/actuators/{host}"

    def reload(self, host: str = ANY) -> str:
        """What became of changed files of behaviours under development."""
        return f"{self.swarm}/reload/{host}"

    def processes(self, host: str = ANY) -> str:
        """The processes that a supervisor keeps running."""
        return f"{self.swarm}/processes/{host}"

    def intervention(self, host: str = ANY) -> str:
        """What the safety filter changes."""
        return f"{self.swarm}/intervention/{host}"

    @property
    def stop(self) -> str:
        """Stand still."""
        return f"{self.swarm}/stop"

    @property
    def estop(self) -> str:
        """Latched emergency stop and its release."""
        return f"{self.swarm}/estop"

    def estop_receipt(self, robot: str = ANY) -> str:
        """Orders to stop."""
        return f"{self.swarm}/estop/receipt/{robot}"

    def ping(self, robot: str = ANY) -> str:
        """Asks a robot whether it is there."""
        return f"{self.swarm}/robot/{robot}/ping"

    def pong(self, robot: str = ANY) -> str:
        """It is."""
        return f"{self.swarm}/robot/{robot}/pong"

    def measurement(self, metric: str = ANY, host: str = ANY) -> str:
        """Results of the calculators."""
        return f"{self.swarm}/measurement/{metric}/{host}"

    def summary(self, metric: str = ANY) -> str:
        """Results of the summarizers."""
        return f"{self.swarm}/summary/{metric}"

    def renewal_request(self, name: str = ANY) -> str:
        """Requests of processes for a new certificate."""
        return f"{self.swarm}/identity/{name}/renew"

    def renewal_reply(self, name: str = ANY) -> str:
        """The authority's answers to them."""
        return f"{self.swarm}/identity/{name}/certificate"

    def param_request(self, layer: str) -> str:
        """Questions to a layer's local database."""
        return f"{self.swarm}/params/{layer}/request"

    def param_reply(self, layer: str, request_id: str = ANY) -> str:
        """Its answers."""
        return f"{self.swarm}/params/{layer}/reply/{request_id}"

    def param_changed(self, layer: str = ANY) -> str:
        """Its changes."""
        return f"{self.swarm}/params/{layer}/changed"


WHOLE_SWARM_CELL = "all"
"""The one cell of a swarm whose states are not split by place (`cell_m` = 0)."""


def cell_of(x_m: float, y_m: float, cell_m: float) -> str:
    """Name the grid cell that holds a position; ``all`` when the grid is off (`cell_m` <= 0)."""
    if cell_m <= 0.0:
        return WHOLE_SWARM_CELL
    return f"{math.floor(x_m / cell_m)}_{math.floor(y_m / cell_m)}"


def cells_within(x_m: float, y_m: float, reach_m: float, cell_m: float) -> set[str]:
    """Name all cells that a disc of radius `reach_m` touches (its bounding square)."""
    if cell_m <= 0.0:
        return {WHOLE_SWARM_CELL}
    low_x, high_x = math.floor((x_m - reach_m) / cell_m), math.floor((x_m + reach_m) / cell_m)
    low_y, high_y = math.floor((y_m - reach_m) / cell_m), math.floor((y_m + reach_m) / cell_m)
    return {f"{column}_{row}" for column in range(low_x, high_x + 1) for row in range(low_y, high_y + 1)}
