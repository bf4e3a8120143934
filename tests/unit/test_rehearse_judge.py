"""The judge of a rehearsal sees each thing that must not be, and nothing where all is well."""

from __future__ import annotations

import msgspec
import pytest

from fullswarm.messages import (
    Command,
    ControlAck,
    ControlRequest,
    EStop,
    HealthReport,
    Heartbeat,
    Lease,
    Leases,
    RequestStatus,
    RobotHealth,
    StopRequest,
)
from fullswarm.rehearse.judge import Ask, Judge


class Scene:
    """Two robots; `r1` runs a request that was made at 1 s."""

    def __init__(self, behaviour: str = "rendezvous_bc", kind: str = "request") -> None:
        self.t, self.hub_gone_s = 1.0, float("inf")
        self.judge = Judge(("r1", "r2"), lambda: self.t, lambda _: self.hub_gone_s)
        self.judge.asked(Ask(1.0, "ann", kind, "q", ("r1",), behaviour))
        self.at(1.1)
        self.beat()
        self.accept("q", 1, expires_s=0.3 if kind == "stick" else 0.0)
        self.command("q")

    def at(self, t: float) -> None:
        self.t = t

    def beat(self) -> None:
        self.judge.handled("r1", Heartbeat(node="core", process="c", sequence=1))

    def command(self, request_id: str) -> None:
        self.judge.handled(
            "r1",
            Command(
                robot="r1", request_id=request_id, linear_m_s=0.1, angular_rad_s=0.0, ttl_s=0.3, sequence=9, stamp_s=0.0
            ),
        )

    def accept(self, request_id: str, sequence: int, *, expires_s: float = 0.0) -> None:
        request = ControlRequest(
            request_id=request_id, robot="r1", behaviour="b", enable=True, core="c", sequence=sequence,
            expires_s=expires_s,
        )  # fmt: skip
        self.judge.handled("r1", request)
        ack = ControlAck(
            request_id=request_id, robot="r1", behaviour="b", enabled=True, accepted=True, core="c", sequence=sequence
        )
        self.judge.published("r1", ack)

    def stop(self, at_s: float) -> None:
        self.judge.asked(Ask(at_s, "bob", "stop", "s", ("r1", "r2")))
        self.judge.handled("r1", StopRequest(id="s"))

    def estop(self, order_id: str, *, engaged: bool) -> None:
        order = EStop(id=order_id, engaged=engaged)
        self.judge.asked(Ask(self.t, "bob", "e-stop" if engaged else "release", order_id, ("r1", "r2")))
        self.judge.published("bob", order)
        self.judge.handled("r1", order)

    def report(self, request_id: str, *, estop: bool = False) -> None:
        health = RobotHealth(
            robot="r1", driver="", make="", model="", firmware="", lifecycle="ACTIVE", estop=estop,
            behaviour="b" if request_id else "", request_id=request_id,
        )  # fmt: skip
        self.judge.published("r1", HealthReport(host="r1", process="r1-1", version="", robots=(health,)))

    def status(self, request_id: str, phase: str = "running") -> None:
        status = RequestStatus(request_id=request_id, behaviour="b", phase=phase, robots=("r1",))  # type: ignore[arg-type]
        self.judge.published("core", status)

    def moves(self) -> list[str]:
        self.judge.commanded("r1", 0.2, 0.0)
        return self.kinds()

    def kinds(self) -> list[str]:
        return [each.kind for each in self.judge.violations]


def test_a_motion_for_what_was_asked() -> None:
    scene = Scene()
    assert scene.moves() == []
    scene.judge.commanded("r2", 0.0, 0.0)
    assert scene.kinds() == []
    scene.judge.commanded("r2", 0.0, 0.1)
    assert scene.kinds() == ["motion"], "it was asked for nothing"


def test_a_motion_of_an_agent_that_has_been_started_again_and_accepted_nothing() -> None:
    scene = Scene()
    scene.judge.died("r1")
    scene.beat()
    assert scene.moves() == ["motion"]


def test_a_request_that_nobody_made() -> None:
    scene = Scene()
    scene.accept("forged", 2)
    assert scene.moves() == ["motion"]


def test_a_stop_counts_for_what_was_requested_before_it() -> None:
    scene = Scene()
    scene.at(2.0)
    scene.beat()
    scene.stop(1.5)
    assert scene.moves() == [], "in the same period"
    scene.at(2.03)
    scene.accept("q", 2)
    assert "stop" in scene.moves()
    scene = Scene()
    scene.at(2.0)
    scene.stop(0.5)
    scene.at(2.03)
    scene.beat()
    scene.accept("q", 1)
    assert scene.moves() == [], "it was made before the request"


def test_a_latch_holds_through_restarts_until_a_newer_release() -> None:
    scene = Scene()
    scene.at(2.0)
    scene.estop("e", engaged=True)
    scene.judge.died("r1")
    scene.at(2.5)
    scene.beat()
    scene.report("", estop=True)
    assert scene.kinds() == []
    scene.report("", estop=False)
    assert scene.kinds() == ["e-stop"]
    scene.at(3.0)
    scene.estop("c", engaged=False)
    scene.judge.asked(Ask(3.1, "ann", "request", "r", ("r1",), "rendezvous_bc"))
    scene.at(3.2)
    scene.accept("r", 5)
    assert scene.moves() == ["e-stop"], "nothing new"


@pytest.mark.parametrize(
    ("behaviour", "kind", "silent_s", "wrong"),
    [
        ("rendezvous_bc", "request", 1.01, False),
        ("rendezvous_bc", "request", 1.03, True),
        ("voronoi_centralised_bc", "request", 0.31, False),
        ("voronoi_centralised_bc", "request", 0.33, True),
        ("drive_bc", "stick", 0.31, False),
        ("drive_bc", "stick", 0.33, True),
    ],
)
def test_a_motion_in_silence(behaviour: str, kind: str, silent_s: float, wrong: bool) -> None:
    scene = Scene(behaviour, kind)
    scene.at(1.1 + silent_s)
    assert scene.moves() == ["silence"] * wrong


def test_a_motion_without_a_hub_and_without_readings() -> None:
    scene = Scene()
    scene.hub_gone_s = 1.0
    assert scene.moves() == ["silence"]
    scene = Scene()
    scene.judge.deceived("r1", 0.7)
    assert scene.moves() == ["silence"]


def test_a_body_that_goes_on_and_one_that_touches() -> None:
    scene = Scene()
    scene.moves()
    scene.at(1.7)
    scene.judge.stepped((0.3, 0.0), ())
    assert scene.kinds() == []
    scene.at(1.75)
    scene.judge.stepped((0.3, 0.0), ())
    assert scene.kinds() == ["standing"]
    scene.judge.stepped((0.0, 0.0), ((0, 1),))
    scene.judge.stepped((0.0, 0.0), ((0, 1),))
    assert scene.kinds() == ["standing", "contact"], "once"
    scene = Scene()
    scene.judge.hindered("r2")
    scene.judge.stepped((0.0, 0.0), ((0, 1),))
    assert scene.kinds() == []
    assert scene.judge.excused == 1


def test_a_contact_into_which_a_deceived_robot_pushes_others() -> None:
    now_s = 1.0
    judge = Judge(("r1", "r2", "r3", "r4"), lambda: now_s, lambda _: float("inf"))
    still = (0.0, 0.0, 0.0, 0.0)
    judge.deceived("r4", 1.0)
    judge.stepped(still, ((2, 3),))
    now_s += 0.2  # they bounce apart
    judge.stepped(still, ())
    judge.stepped(still, ((1, 2),))
    assert (judge.excused, judge.violations) == (2, [])
    judge.stepped(still, ((1, 2), (2, 3)))
    now_s += 0.2
    judge.stepped(still, ((0, 1), (1, 2), (2, 3)))
    judge.stepped(still, ((0, -1), (0, 1)))
    assert (judge.excused, judge.violations) == (5, []), "all along the chain, into a wall too"
    now_s += 0.3
    judge.stepped(still, ())
    judge.stepped(still, ((0, 1),))
    assert [(each.kind, each.robot) for each in judge.violations] == [("contact", "r1")], "nothing pushes any more"


def test_robots_that_touch_each_other_do_not_excuse_each_other() -> None:
    now_s = 1.0
    judge = Judge(("r1", "r2", "r3"), lambda: now_s, lambda _: float("inf"))
    judge.hindered("r3")
    judge.stepped((0.0, 0.0, 0.0), ((0, 1), (1, 2)))
    for _ in range(100):
        now_s += 0.02
        judge.stepped((0.0, 0.0, 0.0), ((0, 1), (1, 2)))
    assert judge.violations == []
    judge.stepped((0.0, 0.0, 0.0), ((0, 1), (1, 2), (0, -1)))
    assert [each.kind for each in judge.violations] == ["contact"]


def test_an_estop_that_the_core_repeats_is_as_old_as_the_operators() -> None:
    scene = Scene()
    scene.estop("e", engaged=True)
    scene.at(2.0)
    release = EStop(id="f", engaged=False)
    scene.judge.asked(Ask(2.0, "bob", "release", "f", ("r1", "r2")))
    scene.judge.published("bob", release)
    scene.at(2.5)
    repeated = EStop(id="core-estop-1", engaged=True, robots=("r1",), source="core")
    scene.judge.published("core", repeated)
    scene.judge.handled("r1", repeated)
    scene.at(2.6)
    scene.judge.handled("r1", release)
    scene.at(3.0)
    scene.report("")
    assert scene.kinds() == []
    newer = EStop(id="g", engaged=True)
    scene.judge.asked(Ask(3.0, "bob", "e-stop", "g", ("r1", "r2")))
    scene.judge.published("bob", newer)
    scene.judge.handled("r1", newer)
    scene.at(3.5)
    scene.report("")
    assert scene.kinds() == ["e-stop"]


def test_a_body_that_is_pushed_does_not_move_by_itself() -> None:
    scene = Scene()
    scene.moves()
    scene.at(5.0)
    scene.judge.stepped((0.05, 0.3), ((0, 1),))
    assert scene.kinds() == ["contact"]
    scene.judge.stepped((0.05, 0.0), ())  # it was pushed in the step before
    assert scene.kinds() == ["contact"]
    scene.judge.stepped((0.05, 0.0), ())
    assert scene.kinds() == ["contact", "standing"]
    scene = Scene()
    scene.moves()
    scene.at(5.0)
    scene.judge.stepped((0.05, 0.0), ((0, -1),))  # a wall pushes nothing
    assert "standing" in scene.kinds()


def test_a_request_that_is_carried_out_twice_and_an_older_one_after_a_newer() -> None:
    scene = Scene()
    scene.accept("q", 1)
    assert scene.kinds() == [], "the same answer again"
    scene.accept("q", 3)
    assert scene.kinds() == ["twice"]
    scene.accept("p", 2)
    assert scene.kinds() == ["twice", "twice"]


def test_two_holders_and_a_request_of_another_operator() -> None:
    scene = Scene()
    leases = (Lease(robot="r1", operator="bob", age_s=0.0), Lease(robot="r2", operator="bob", age_s=0.0))
    scene.judge.published("core", Leases(leases=leases, core="c", sequence=1))
    scene.at(2.0)
    scene.status("q")
    assert scene.kinds() == ["lease"]
    twice = (*leases, Lease(robot="r1", operator="ann", age_s=0.0))
    scene.judge.published("core", Leases(leases=twice, core="c", sequence=2))
    assert scene.kinds() == ["lease", "lease"]


def test_what_is_left_at_the_end() -> None:
    scene = Scene()
    scene.status("q")
    scene.report("q")
    scene.judge.finish((), (), {"ann": ("r1",), "bob": ("r2",)})
    assert scene.kinds() == []
    scene.report("")
    scene.judge.finish(("x",), (), {"ann": ("r1",), "bob": ("r1",)})
    assert scene.kinds() == ["unanswered", "lease", "last"]


def test_a_robot_may_stand_that_has_left_a_request_for_one_that_it_refused() -> None:
    scene = Scene()
    scene.status("q")
    scene.report("")
    scene.at(3.0)
    scene.judge.asked(Ask(3.0, "eve", "request", "p", ("r1",), "rendezvous_bc"))
    scene.status("p")
    running = RequestStatus(request_id="p", behaviour="rendezvous_bc", phase="running", robots=("r1", "r2"))
    for status in (
        msgspec.structs.replace(running, refused_by=("r2",)),
        msgspec.structs.replace(running, refused_by=("r1",)),
        msgspec.structs.replace(running, phase="refused"),
    ):
        scene.judge.published("core", status)
        scene.judge.violations.clear()
        scene.judge._told.clear()
        scene.judge.finish((), (), {})
        assert scene.kinds() == (["last"] if status.refused_by == ("r2",) else []), status
    scene.at(5.0)
    scene.judge.asked(Ask(5.0, "ann", "request", "o", ("r1",), "rendezvous_bc"))
    scene.status("o")
    scene.judge.finish((), (), {})
    assert scene.kinds() == ["last"], "it was asked for another one since"


def test_an_error_of_a_node() -> None:
    scene = Scene()
    scene.judge.raised("core", "ValueError: no")
    assert scene.kinds() == ["error"]
