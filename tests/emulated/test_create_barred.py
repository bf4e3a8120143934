"""A Create that does not drive although somebody asks: it says why, for as long as that matters."""

from __future__ import annotations

from fullswarm.drivers.base import Lifecycle
from fullswarm.drivers.create_oi.firmware import Quirks
from fullswarm.drivers.create_oi.session import NEWS_S
from tests.emulated.create_bench import GO, Bench


def asked(bench: Bench, duration_s: float) -> set[str]:
    """Ask for motion as an agent does, again and again; return what was told as its trouble."""
    told = set()
    for _ in range(round(duration_s / 0.02)):
        bench.session.activate(bench.clock.now_s())
        bench.run(0.02, GO)
        told.add(bench.session.trouble(bench.clock.now_s()))
    return told


def test_what_bars_a_robot_is_its_trouble_while_somebody_asks() -> None:
    bench = Bench()
    bench.run(0.2)
    bench.robot.charger = True
    bench.run(0.2)
    assert bench.session.trouble(bench.clock.now_s()) == ""  # nobody wants to drive it
    assert asked(bench, 5.0) == {"bench: not activated: the charger is plugged in; mend that first"}
    assert bench.at(Lifecycle.READY)
    assert bench.session.fault == ""
    bench.run(NEWS_S + 0.1)
    assert bench.session.trouble(bench.clock.now_s()) == ""
    assert "charger" in bench.session.blocked  # still there for who asked
    bench.robot.charger = False
    bench.run(0.2)
    asked(bench, 0.2)
    assert bench.at(Lifecycle.ACTIVE)
    assert bench.session.trouble(bench.clock.now_s()) == ""
    bench.robot.drops[0] = True
    bench.run(0.1)
    assert "stopped itself: a wheel hangs" in bench.session.trouble(bench.clock.now_s())
    bench.run(NEWS_S)
    assert bench.session.trouble(bench.clock.now_s()) == ""


def test_an_unconfirmed_activation_is_told_without_a_gap_between_the_tries() -> None:
    deaf = Bench(quirks=Quirks(deaf_to_safe=True))
    deaf.run(0.2)
    asked(deaf, 1.0)
    [told] = asked(deaf, 5.0)
    assert "take it off its charger" in told


def test_what_barred_a_robot_is_forgotten_with_the_link() -> None:
    bench = Bench()
    bench.robot.charger = True
    bench.run(0.2)
    asked(bench, 0.1)
    bench.session.lost("unplugged")
    bench.session.linked(bench.clock.now_s())
    bench.run(0.3)
    assert bench.at(Lifecycle.READY)
    assert bench.session.trouble(bench.clock.now_s()) == ""
