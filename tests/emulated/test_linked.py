"""The link runner under a session with defects, on a real pseudo-terminal."""

from __future__ import annotations

import errno
import math
import os
import pty
import tty
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from fullswarm.drivers.base import STAND, Description, Lifecycle, Limits, Twist
from fullswarm.drivers.linked import TTL_S, CommandGate, LinkedDriver, LinkSession
from fullswarm.drivers.ports import SerialPort
from tests.waiting import until

DESCRIPTION = Description("Clumsy", "C1", 0.2, Limits(0.5, 2.0, 1.0, 4.0))


class Clumsy(LinkSession[bytes]):
    """Cannot take bytes; sends what it was given."""

    def __init__(self) -> None:
        self.links = self.ticks = 0
        self.losses: list[str] = []
        self.out: list[bytes] = []
        self.twist = STAND

    def linked(self, now_s: float) -> None:
        self.links += 1
        self.state = Lifecycle.READY

    def lost(self, reason: str, now_s: float) -> None:
        super().lost(reason, now_s)
        self.losses.append(reason)

    def received(self, chunk: bytes, now_s: float) -> None:
        raise RuntimeError(f"cannot read {chunk!r}")

    def tick(self, now_s: float) -> list[bytes]:
        self.ticks += 1
        out, self.out = self.out, []
        return out

    def command(self, twist: Twist, now_s: float) -> Twist:
        self.twist = twist
        return twist

    def final_stop(self) -> list[bytes]:
        return [b"stop"]


@contextmanager
def linked() -> Iterator[tuple[int, LinkedDriver[bytes], Clumsy]]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    session, path = Clumsy(), os.ttyname(slave)
    driver = LinkedDriver(
        f"clumsy://{path}", DESCRIPTION, session=lambda _: session, port=lambda: SerialPort(path, 115200)
    )
    driver.open()
    try:
        yield master, driver, session
    finally:
        driver.close()
        os.close(master)
        os.close(slave)


def test_a_defect_in_a_session_still_stops_its_robot_and_is_a_fault() -> None:
    with linked() as (master, driver, session):
        until(lambda: session.ticks > 0)
        driver.activate()
        assert driver.command(Twist(0.1, 0.0)) == Twist(0.1, 0.0)
        os.write(master, b"x")
        assert os.read(master, 4) == b"stop"
        until(lambda: driver.state is Lifecycle.FAULT)
        assert "internal error: RuntimeError: cannot read b'x'" in driver.fault
        assert driver.command(Twist(0.1, 0.0)) == STAND


def test_a_port_that_takes_no_bytes_is_lost_and_gets_nothing_old_when_it_is_back() -> None:
    with linked() as (master, driver, session):
        until(lambda: session.ticks > 0)
        driver.do(lambda _: session.out.append(bytes(100_000)))
        until(lambda: bool(session.losses))
        assert "takes no bytes" in session.losses[0]
        until(lambda: session.links == 2)  # opened again, without the old bytes
        driver.do(lambda _: session.out.append(b"new"))
        told = b""
        while not told.endswith(b"new"):
            told += os.read(master, 65536)
        assert len(told) < 50_000


def test_close_sends_the_final_stop_and_an_open_driver_may_be_closed_twice() -> None:
    with linked() as (master, driver, session):
        until(lambda: session.ticks > 0)
        driver.close()
        assert os.read(master, 16) == b"stop"
        driver.close()
        assert driver.state is Lifecycle.CLOSED


def test_a_computer_without_room_for_a_pipe_releases_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    with linked() as (_, driver, _session):
        driver.close()
        with monkeypatch.context() as short:
            short.setattr("fullswarm.drivers.linked.os.pipe2", no_room)
            with pytest.raises(Exception, match="end other programs"):
                driver.open()
        driver.open()
        until(lambda: driver.state is Lifecycle.READY)


def no_room(*_: object) -> None:
    raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))


def test_the_gate_passes_only_finite_commands_and_stops_the_robot_when_none_comes() -> None:
    session = Clumsy()
    gate = CommandGate(session)
    session.state = Lifecycle.READY
    assert gate.command(Twist(0.3, 0.0), 10.0) == STAND
    session.state = Lifecycle.ACTIVE
    assert gate.command(Twist(0.3, 0.0), 10.0) == Twist(0.3, 0.0)
    assert gate.due_s(10.0) == 10.0 + TTL_S
    gate.check(10.0 + TTL_S - 0.01)
    assert session.twist == Twist(0.3, 0.0)
    gate.check(10.0 + TTL_S + 0.01)
    assert session.twist == STAND
    gate.command(Twist(0.3, 0.0), 11.0)
    for bad in (Twist(math.nan, 0.0), Twist(0.0, math.inf)):
        with pytest.raises(ValueError, match="finite"):
            gate.command(bad, 11.0)
    assert session.twist == STAND
    with pytest.raises(ValueError, match="finite"):
        CommandGate[bytes]().command(Twist(math.nan, 0.0), 0.0)
