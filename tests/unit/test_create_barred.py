"""A Create that does not drive although somebody asks: it says why, for as long as that matters."""

from __future__ import annotations

import random

from fullswarm.drivers.base import Lifecycle
from fullswarm.drivers.create_oi.session import NEWS_S
from fullswarm.emulators.create_oi.firmware import Quirks
from tests.unit.create_bench import GO, Bench


def asked(bench: Bench, duration_s: float) -> set[str]:
    """Ask for motion as an agent does, again and again; return what was told as its trouble."""
    told = set()
    for _ in range(round(duration_s / 0.02)):
        bench.session.activate(bench.clock.now_s())
        bench.run(0.02, GO)
        told.add(bench.trouble())
    return told


def test_what_bars_a_robot_is_its_trouble_while_somebody_asks() -> None:
    bench = Bench()
    bench.run(0.2)
    bench.robot.charger = True
    bench.run(0.2)
    assert bench.trouble() == ""  # nobody wants to drive it
    assert asked(bench, 5.0) == {"bench: not activated: the charger is plugged in; mend that first"}
    assert bench.at(Lifecycle.READY)
    assert bench.session.fault == ""
    bench.run(NEWS_S + 0.1)
    assert bench.trouble() == ""
    assert "charger" in bench.session.blocked  # still there for who asked
    bench.robot.charger = False
    bench.run(0.2)
    asked(bench, 0.2)
    assert bench.at(Lifecycle.ACTIVE)
    assert bench.trouble() == ""
    bench.robot.drops[0] = True
    bench.run(0.1)
    assert "stopped itself: a wheel hangs" in bench.trouble()
    bench.run(NEWS_S)
    assert bench.trouble() == ""


def test_an_unconfirmed_activation_is_told_without_a_gap_between_the_tries() -> None:
    deaf = Bench(quirks=Quirks(deaf_to_safe=True))
    deaf.run(0.2)
    asked(deaf, 1.0)
    [told] = asked(deaf, 5.0)
    # Not "take it off its charger": it tells that it is on none.
    assert "within 0.5 s: the cause is unknown; check the cable, then restart the robot" in told
    deaf.robot.dock = True
    deaf.run(0.2)
    asked(deaf, 1.0)
    [told] = asked(deaf, 2.0)
    assert told.endswith("within 0.5 s: it is on its charger; take it off")


def test_a_line_that_loses_bytes_is_not_taken_for_a_charger() -> None:
    bench = Bench()
    bench.run(0.2)
    luck, receive = random.Random(3), bench.session.received

    def lossy(data: bytes, now_s: float) -> None:
        receive(bytes(byte for byte in data if luck.random() >= 0.01), now_s)

    bench.session.received = lossy  # type: ignore[method-assign]
    bench.carry = lambda data: bench.wire.extend(data if luck.random() < 0.02 else b"")
    told = asked(bench, 5.0)
    assert not any("charger" in each for each in told)
    assert any("Safe mode within 0.5 s: the line is bad, " in each for each in told)


def test_a_line_that_garbles_everything_is_not_called_silent() -> None:
    bench = Bench().active()
    receive = bench.session.received
    bench.session.received = lambda data, now_s: receive(bytes(len(data)), now_s)  # type: ignore[method-assign]
    bench.run(0.6)
    assert "no good frame for 0.5 s, only " in bench.session.fault
    assert "damaged bytes: check the cable" in bench.session.fault
    silent = Bench().active()
    silent.cut = True
    silent.run(0.6)
    assert "silent for 0.5 s: check its power and the cable" in silent.session.fault


def test_a_robot_that_stops_for_no_cause_that_it_tells_says_so() -> None:
    bench = Bench().active()
    bench.robot.receive(bytes([128]), bench.clock.now_s())  # its power button, or a garbled command
    bench.run(0.1)
    assert bench.session.blocked == "the robot stopped itself: the cause is unknown, it is in mode 1"


def test_what_barred_a_robot_is_forgotten_with_the_link() -> None:
    bench = Bench()
    bench.robot.charger = True
    bench.run(0.2)
    asked(bench, 0.1)
    bench.session.lost("unplugged", bench.clock.now_s())
    bench.session.linked(bench.clock.now_s())
    bench.run(0.3)
    assert bench.at(Lifecycle.READY)
    assert bench.trouble() == ""
