from __future__ import annotations

import pytest

from fullswarm.config import PerformanceConfig
from fullswarm.core import main_controller
from fullswarm.messages import ParamChanged, ParamReply, ParamRequest, StopRequest
from tests.unit.core_swarm import KEYS, Swarm, fresh

swarm = pytest.fixture(fresh)


def test_refusals_reach_the_operator_with_a_hint(swarm: Swarm) -> None:
    swarm.ask("a", "flokking")
    swarm.ask("b", "rendezvous", gain=9)
    swarm.ask("c", "flocking", "r0", "r11")
    swarm.run(0.05)
    assert swarm.status("a").reason == "unknown behaviour 'flokking' (did you mean 'flocking'?)"
    assert swarm.status("b").reason.startswith("gain = 9 is outside [0.05, 5] 1/s")
    assert swarm.status("c").reason == "unknown robot 'r11' (did you mean 'r1'?)"
    assert swarm.behaviours() == ["", "", ""]
    swarm.ask("a", "flokking")
    swarm.run(0.05)
    assert swarm.phases("a") == ["refused", "refused"]


def test_nobody_there_is_refused() -> None:
    swarm = Swarm(count=0)
    swarm.ask("a", "flocking")
    swarm.bus.publish(KEYS.stop, StopRequest(id="s"))
    swarm.run(0.05)
    assert (swarm.status("a").phase, "no robot is present" in swarm.status("a").reason) == ("refused", True)
    assert swarm.status("s").phase == "ended"
    swarm.close()


def test_formation_targets_go_by_the_order_of_the_request(swarm: Swarm) -> None:
    swarm.ask("a", "formation", "r2", "r0", targets=[[1.0, 1.0], [2.0, 2.0]])
    swarm.run(0.1)
    targets = {name: robot.task.parameters["target"] for name, robot in swarm.robots.items() if robot.task}
    assert targets == {"r2": [1.0, 1.0], "r0": [2.0, 2.0]}


def test_a_filtered_request_carries_what_the_filter_needs(swarm: Swarm) -> None:
    swarm.ask("a", "move_left_bc", "r0")
    swarm.run(0.1)
    task = swarm.robots["r0"].task
    assert task is not None
    assert (task.law, task.filtered, task.parameters["direction"]) == ("move", True, [-1.0, 0.0])
    assert task.parameters["safety_margin_m"] == swarm.config.agent.safety_margin_m


def test_without_the_extra_a_centralised_behaviour_is_refused(swarm: Swarm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(main_controller, "missing_packages", lambda: ("osqp",))
    swarm.ask("a", "voronoi_centralised")
    swarm.run(0.1)
    assert swarm.status("a").reason == 'a centralised behaviour needs osqp (pip install "fullswarm[core]")'


class Database:
    """Asks the core's database."""

    def __init__(self, swarm: Swarm) -> None:
        self.swarm, self.replies, self.changes = swarm, list[ParamReply](), list[ParamChanged]()
        swarm.bus.subscribe(KEYS.param_reply("core"), ParamReply, self.replies.append)
        swarm.bus.subscribe(KEYS.param_changed("core"), ParamChanged, self.changes.append)

    def ask(self, op: str, key: str, value: object = None, ident: str = "") -> ParamReply:
        request = ParamRequest(id=ident or f"p{len(self.replies)}", op=op, key=key, value=value, author="ann")  # type: ignore[arg-type]
        self.swarm.bus.publish(KEYS.param_request("core"), request)
        self.swarm.run(0.001)
        return self.replies[-1]


def test_settings_change_at_run_time_and_are_checked(swarm: Swarm) -> None:
    database = Database(swarm)
    assert database.ask("get", "schedule_interval_s").entries[0].value == 0.05
    assert database.ask("set", "schedule_interval_s", 1.0).ok
    assert swarm.core.settings.schedule_interval_s == 1.0
    assert [each.entry.key for each in database.changes] == ["schedule_interval_s"]
    bad = database.ask("set", "schedule_interval_s", 99.0)
    assert (bad.ok, "outside [0, 10] s" in bad.reason) == (False, True)
    assert "did you mean 'schedule_interval_s'?" in database.ask("set", "schedule_interval", 1.0).reason
    assert not database.ask("set", "wanted/r0", {"request_id": "x"}).ok
    assert [each.author for each in database.ask("history", "schedule_interval_s").entries] == ["seed", "ann"]
    assert database.ask("get", "nothing").entries == ()
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    swarm.ask("b", "rendezvous")
    swarm.run(0.5)
    assert swarm.status("b").phase == "scheduled"


def test_conditions_and_presence_take_effect(swarm: Swarm) -> None:
    database = Database(swarm)
    assert database.ask("set", "performance/max_execution_s", 60.0).ok
    assert swarm.core.settings.performance == PerformanceConfig(max_execution_s=60.0)
    assert not database.ask("set", "performance/coverage_at_least", 3).ok
    assert database.ask("set", "performance/max_execution_s", None).ok
    assert swarm.core.settings.performance == PerformanceConfig()
    assert database.ask("set", "presence_silence_s", 5.0).ok
    swarm.robots["r0"].kill()
    swarm.run(3.0)
    assert swarm.core.roster.present() == ("r0", "r1", "r2")
    swarm.run(3.0)
    assert swarm.core.roster.present() == ("r1", "r2")


def test_a_repeated_set_is_answered_but_done_once(swarm: Swarm) -> None:
    database = Database(swarm)
    database.ask("set", "schedule_interval_s", 1.0, "same")
    database.ask("set", "schedule_interval_s", 2.0)
    assert database.ask("set", "schedule_interval_s", 1.0, "same").ok
    assert swarm.core.settings.schedule_interval_s == 2.0


def test_records_can_be_added_while_it_runs(swarm: Swarm) -> None:
    database = Database(swarm)
    listed = {each.key: each.value for each in database.ask("get", "behaviour/*").entries}
    twin = listed["behaviour/flocking_bc"]
    assert isinstance(twin, dict)
    assert twin["filtered"] is True
    assert "cruise_m_s" in str(twin["parameters"])  # shown with what it is like
    broken = database.ask("set", "behaviour/fast", {"like": "flokking"})
    assert "did you mean 'flocking'?" in broken.reason
    assert database.ask("set", "behaviour/fast", {"like": "flocking", "static": {"hearing_m": 9.0}}).ok
    swarm.ask("a", "fast")
    swarm.run(0.1)
    task = swarm.robots["r0"].task
    assert task is not None
    assert (task.behaviour, task.law, task.parameters["hearing_m"]) == ("fast", "flocking", 9.0)
