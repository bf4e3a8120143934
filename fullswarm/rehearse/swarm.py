"""Builds a whole swarm whose nodes are processes of their own on a simulated clock, and injects faults into it."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from fullswarm import kernels
from fullswarm.agent.orders.estops import LatchFolder
from fullswarm.agent.state import Identity
from fullswarm.bus.base import CENTRALISED, CORE
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.config.docks import slots_of
from fullswarm.keys import Keys
from fullswarm.launch import nodes
from fullswarm.messages import Message
from fullswarm.rehearse.disk import RehearsedDisk, RehearsedStore
from fullswarm.rehearse.driver import FROZEN, RAISES, STALE, UNPLUGGED, Lie, RehearsedFleet
from fullswarm.rehearse.faults import Fault
from fullswarm.rehearse.judge import Ask, Judge
from fullswarm.rehearse.network import Network, Trouble
from fullswarm.rehearse.operators import Action, Life, Player
from fullswarm.rehearse.process import HostClock, InjectedCrash, SimProcess
from fullswarm.runtime import Runtime
from fullswarm.simulation.world import World

BASE = "base"
"""The computer of hub, core, centralised behaviours and operators."""
WALL_S = 1.7e9
"""Seconds since 1970 at the beginning of each episode."""
RECONNECT_S = (0.05, 0.8)
"""A client finds the hub again so long after its start."""
REVIVE_S = 0.5
"""A process that ended by itself is started again after so long."""
LYING_POSE = (FROZEN, STALE, UNPLUGGED)


def fleet(count: int) -> SwarmConfig:
    """Return the settings of a swarm of `count` robots in an arena of a size that makes them meet."""
    side_m = max(6.0, 2.0 * count**0.5 + 2.0)
    return SwarmConfig.model_validate(
        {
            "swarm": "rehearsal",
            "robot": [{"id": f"r{number}"} for number in range(1, count + 1)],
            "world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, side_m, side_m)},
        }
    )


class RehearsedSwarm:
    """Hub, core, centralised node, an agent per robot and operators, each a :class:`SimProcess`.

    Parameters
    ----------
    folder : for the disks
    seed : of everything that is drawn here
    act_until_s : operators do nothing new after this simulated time
    """

    def __init__(
        self, config: SwarmConfig, folder: Path, seed: str, operators: Sequence[str], act_until_s: float
    ) -> None:
        kernels.compile_all()
        self.config, self._seed, self._act_until_s = config, seed, act_until_s
        self.simulation = simulation = Runtime(SimClock())
        self.keys = Keys(config.swarm)
        settings = config.world_or_default.model_copy(update={"seed": self._chance("world").randrange(2**31)})
        self.config = config = config.model_copy(update={"world": settings})
        self.world = World(settings, config.robots, nodes.start_poses(config), slots_of(config))
        self.network = Network(simulation, self._chance("network"), self._handled, self._published)
        self.judge = Judge(config.robots, simulation.now_s, self._hub_gone_s)
        origins = self._chance("clocks")
        self.hosts = {
            name: HostClock(simulation.now_s, name, origins.uniform(0.0, 1e6)) for name in (BASE, *config.robots)
        }
        self.disks = {name: RehearsedDisk(folder / name) for name in (BASE, *config.robots)}
        self.lies = {robot: Lie() for robot in config.robots}
        self.lives = {name: Life(name, self._chance(f"operator {name}")) for name in operators}
        self.players: dict[str, Player] = {}
        self._store: RehearsedStore | None = None
        self.processes: dict[str, SimProcess] = {}
        self._add(CORE, BASE, self._build_core)
        self._add(CENTRALISED, BASE, self._build_centralised)
        for row, robot in enumerate(config.robots):
            self._add(robot, robot, partial(self._build_agent, row))
        for name in operators:
            self._add(name, BASE, self._build_operator)
        simulation.every(1.0 / settings.rate_hz, self._step)
        starts = self._chance("starts")
        for process in self.processes.values():
            process.on_death = partial(self._died, process)
            simulation.after(starts.uniform(0.0, 0.5), process.start)
        self.restarts = 0

    def _chance(self, name: str) -> random.Random:
        return random.Random(f"{self._seed}:{name}")  # noqa: S311  (must repeat, keeps no secret)

    def _add(self, name: str, host: str, build: Callable[[SimProcess], None]) -> None:
        self.processes[name] = SimProcess(name, self.hosts[host], self.simulation, build, self._raised)

    # ---------------------------------------------------------------- processes
    def _build_core(self, process: SimProcess) -> None:
        disk = self.disks[BASE]
        disk.stall = process.stall
        wall_s = lambda: WALL_S + self.simulation.now_s()  # noqa: E731
        self._store = RehearsedStore(disk, wall_s, self.simulation.now_s)
        bus = self.network.bus_of(process)
        nodes.core(bus, process.runtime, self.config, process.process_id, wall_s, store=self._store)

    def _build_centralised(self, process: SimProcess) -> None:
        nodes.centralised(self.network.bus_of(process), process.runtime, self.config, process.process_id)

    def _build_agent(self, row: int, process: SimProcess) -> None:
        robot = self.config.robots[row]
        disk = self.disks[robot]
        disk.stall = process.stall
        fleet = RehearsedFleet(
            self.world, row, process.host.now_s, self.simulation.now_s, self.config.agent.sensing_radius_m,
            self.lies[robot], partial(self.judge.commanded, robot),
        )  # fmt: skip
        bus, identity = self.network.bus_of(process), Identity(robot, process.process_id)
        agent = nodes.agent(bus, process.runtime, self.config, fleet, identity, process.runtime.stats)
        agent.inbox.remember_latches(LatchFolder(disk.folder / "estop", process.host.name, disk))
        if self.lies[robot].kind in (STALE, UNPLUGGED):  # a new driver reads truly once
            self.judge.deceived(robot, self.simulation.now_s())

    def _build_operator(self, process: SimProcess) -> None:
        self.players[process.name] = Player(
            self.lives[process.name], self.network.bus_of(process), self.keys, process.runtime, process.host.name,
            self.config.robots, self.config.bounds_m, self.simulation.now_s, self._act_until_s, self._acted,
        )  # fmt: skip

    def _acted(self, action: Action) -> None:
        self.judge.asked(
            Ask(action.at_s, action.operator, action.kind, action.id, action.robots, action.behaviour, action.take)
        )

    def _died(self, process: SimProcess) -> None:
        self.network.drop(process.name)
        self.judge.died(process.name)
        if process.name == CORE and self._store is not None:
            self._store.die()
            self._store = None
        if process.name in self.lives:
            self.players.pop(process.name, None)
            self.lives[process.name].die()

    def _raised(self, process: SimProcess, error: Exception) -> None:
        if not isinstance(error, InjectedCrash):
            trace = error.__traceback__
            while trace is not None and trace.tb_next is not None:
                trace = trace.tb_next
            where = f" at {Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}" if trace else ""
            self.judge.raised(process.name, f"{type(error).__name__}: {error}{where}")
        self.revive(process, REVIVE_S)

    def kill(self, name: str) -> None:
        """End a process as SIGKILL does."""
        self.processes[name].kill()

    def revive(self, process: SimProcess, after_s: float) -> None:
        """Start a process again later, as its supervisor does."""

        def start() -> None:
            if not process.alive:
                self.restarts += 1
                process.start()

        self.simulation.after(after_s, start)

    # ---------------------------------------------------------------- what the judge sees
    def _handled(self, sender: str, receiver: str, key: str, message: Message) -> None:
        del sender, key
        self.judge.handled(receiver, message)

    def _published(self, sender: str, receiver: str, key: str, message: Message) -> None:
        del receiver, key
        self.judge.published(sender, message)

    def _hub_gone_s(self, robot: str) -> float:
        """Return since when the hub is gone for a robot; infinity: it is there."""
        if self.network.hub_up and self.network.linked(robot):
            return float("inf")
        return self.network.hub_ended_s

    def _step(self) -> None:
        self.world.step()
        for robot in self.config.robots:
            process = self.processes[robot]
            if not process.alive or process.frozen or process.lag_s > 0.0:
                self.judge.hindered(robot)
        pairs = self.world.pairs
        self.judge.stepped(
            self.world.twist[:, 0].tolist(), [(int(one), int(other)) for one, other in pairs] if len(pairs) else ()
        )

    # ---------------------------------------------------------------- faults
    def inject(self, faults: Sequence[Fault]) -> None:
        """Have these faults happen when their time comes."""
        for each in faults:
            self.simulation.after(each.at_s - self.simulation.now_s(), partial(self._begin, each))

    def _begin(self, fault: Fault) -> None:
        end = INJECT[fault.kind](self, fault)
        if end is not None:
            self.simulation.after(fault.lasts_s, end)

    def crash(self, fault: Fault) -> None:
        """End a process; its disk is as it was."""
        process = self.processes[fault.targets[0]]
        process.kill()
        self.revive(process, fault.lasts_s)

    def crash_hub(self, fault: Fault) -> Callable[[], None]:
        """End the hub; when it is back, each process finds it at a time of its own."""
        self.network.end_hub()
        chance = self._chance(f"hub {fault.index}")

        def start() -> None:
            now_s = self.simulation.now_s()
            self.network.start_hub((name, now_s + chance.uniform(*RECONNECT_S)) for name in self.processes)

        return start

    def freeze_hub(self, fault: Fault) -> None:
        """Let the hub hold back all messages for a while."""
        self.network.hub_frozen_until_s = self.simulation.now_s() + fault.lasts_s

    def cut_power(self, fault: Fault) -> None:
        """End all processes of a computer in the middle of what they write, and start it again."""
        host = fault.targets[0]
        chance, clock = self._chance(f"power {fault.index}"), self.hosts[host]
        ended = [each for each in self.processes.values() if each.host is clock]
        if host == BASE:
            if self._store is not None:
                self._store.lose_power(chance)
                self._store = None
            self.judge.core_lost_s = self.simulation.now_s()
        for each in ended:
            each.kill()
            self.revive(each, fault.lasts_s + chance.uniform(0.0, 0.3))
        self.disks[host].tear(chance)
        clock.reboot()

    def fill_disk(self, fault: Fault) -> Callable[[], None]:
        """Let all writes of a computer fail."""
        disk = self.disks[fault.targets[0]]
        disk.full = True
        self.judge.disk_full(fault.targets[0])

        def end() -> None:
            disk.full = False

        return end

    def slow_disk(self, fault: Fault) -> Callable[[], None]:
        """Let each write of a computer take its time."""
        disk = self.disks[fault.targets[0]]
        disk.slow_s = fault.value

        def end() -> None:
            disk.slow_s = 0.0

        return end

    def partition(self, fault: Fault) -> Callable[[], None]:
        """Cut some processes off from all others."""
        cut = frozenset(fault.targets)
        return self.network.inject(Trouble(lambda one, other: (one in cut) != (other in cut), cut=True))

    def cut_one_way(self, fault: Fault) -> Callable[[], None]:
        """Let nothing get to some processes, or nothing get away from them."""
        cut, inwards = frozenset(fault.targets), fault.detail == "in"
        return self.network.inject(
            Trouble(lambda one, other: (other if inwards else one) in cut and one != other, cut=True)
        )

    def disturb(self, fault: Fault) -> Callable[[], None]:
        """Lose, delay, double or reorder what some processes send and receive."""
        names = frozenset(fault.targets)
        trouble = Trouble(lambda one, other: one in names or other in names)
        if fault.kind == "loss":
            trouble.loss = fault.value
        elif fault.kind == "duplicate":
            trouble.duplicate = fault.value
        elif fault.kind == "reorder":
            trouble.reorder = fault.value
        else:
            trouble.delay_s, trouble.jitter_s = fault.value, 0.5 * fault.value
        return self.network.inject(trouble)

    def skew_clock(self, fault: Fault) -> Callable[[], None]:
        """Let a computer's clock run fast or slow."""
        clock = self.hosts[fault.targets[0]]
        clock.run_at(1.0 + fault.value)
        return lambda: clock.run_at(1.0)

    def jump_clock(self, fault: Fault) -> None:
        """Let a computer's clock leap ahead: it was suspended, and woke up."""
        clock = self.hosts[fault.targets[0]]
        clock.jump(fault.value)
        for each in self.processes.values():
            if each.host is clock:
                each.wake(0.0)

    def suspend(self, fault: Fault) -> None:
        """Let a process do nothing for a while, then get all that has come."""
        self.processes[fault.targets[0]].freeze(fault.lasts_s)

    def slow_down(self, fault: Fault) -> Callable[[], None]:
        """Let a process serve everything late."""
        process = self.processes[fault.targets[0]]
        process.lag_s = fault.value

        def end() -> None:
            process.lag_s = 0.0

        return end

    def deceive(self, fault: Fault) -> Callable[[], None]:
        """Let a robot's driver lie."""
        robot = fault.targets[0]
        lie, now_s = self.lies[robot], self.simulation.now_s()
        lie.kind, lie.since_s = fault.detail, now_s
        if fault.detail in (STALE, UNPLUGGED):
            self.judge.deceived(robot, now_s)
        elif fault.detail != RAISES:
            self.judge.misled(robot, until_s=now_s + fault.lasts_s)

        def end() -> None:
            lie.kind = ""
            self.judge.deceived(robot, float("inf"))

        return end

    # ---------------------------------------------------------------- the run
    def run(self, seconds: float) -> None:
        """Let so many simulated seconds pass."""
        self.simulation.run(seconds)

    def finish(self) -> None:
        """Have the judge look at the end."""
        unanswered: list[str] = []
        voided: list[str] = []
        for life in self.lives.values():
            for request_id, pending in life.requests.items():
                if pending.status is None:
                    unanswered.append(request_id)
                elif pending.repeats is False and pending.status.code == "":
                    voided.append(request_id)
            unanswered += [each for each, waiting in life.missions.items() if waiting.reply is None]
        held = {name: player.held() for name, player in self.players.items()}
        self.judge.finish(unanswered, voided, held)

    def close(self) -> None:
        """End all processes and the world."""
        for each in self.processes.values():
            each.kill()
        self.world.close()


INJECT: dict[str, Callable[[RehearsedSwarm, Fault], Callable[[], None] | None]] = {
    "agent-crash": RehearsedSwarm.crash,
    "core-crash": RehearsedSwarm.crash,
    "centralised-crash": RehearsedSwarm.crash,
    "operator-crash": RehearsedSwarm.crash,
    "hub-crash": RehearsedSwarm.crash_hub,
    "hub-freeze": RehearsedSwarm.freeze_hub,
    "power-cut": RehearsedSwarm.cut_power,
    "disk-full": RehearsedSwarm.fill_disk,
    "disk-slow": RehearsedSwarm.slow_disk,
    "partition": RehearsedSwarm.partition,
    "one-way": RehearsedSwarm.cut_one_way,
    "loss": RehearsedSwarm.disturb,
    "delay": RehearsedSwarm.disturb,
    "reorder": RehearsedSwarm.disturb,
    "duplicate": RehearsedSwarm.disturb,
    "clock-skew": RehearsedSwarm.skew_clock,
    "clock-jump": RehearsedSwarm.jump_clock,
    "suspend": RehearsedSwarm.suspend,
    "slow-process": RehearsedSwarm.slow_down,
    "driver-lies": RehearsedSwarm.deceive,
}
"""What begins each kind of fault; it returns what ends it."""
