"""Asks a Create or Roomba what it is, and leaves it as it was found: mode, stream and wheels.

Only packets are queried. A robot that is off gets one byte, 128 (Passive: wheels cannot turn), and is sent back to
sleep. Bytes are spelled with pauses: a Create 1 that listens at half the rate then takes each of them for one above
239, which is no command, while bytes in a row might read as "clean". The faster rate must be tried first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol
from urllib.parse import quote

from fullswarm.clock import Clock
from fullswarm.drivers.create_oi.protocol import (
    CREATE1,
    CREATE2,
    SIZES,
    Generation,
    Mode,
    Op,
    Sensors,
    StreamParser,
    decode,
    pause_stream,
    query,
    simple,
)
from fullswarm.drivers.make import Scope
from fullswarm.drivers.probe.found import Asked, Found
from fullswarm.drivers.probe.line import SerialPort

LISTEN_S = 0.2
ANSWER_S = 0.15
WAKE_S = 0.05
MODE, CREATE1_GROUP, ALL_GROUP = 35, 6, 100
MODES = range(5)
"""Some 600s report theirs one too high."""

MOST_MV, LAST_CHARGING_STATE, LAST_SONG = 30_000, 6, 15


class Port(Protocol):
    """What is asked of a serial port; see :class:`fullswarm.drivers.probe.line.Line`."""

    def spell(self, data: bytes) -> None:
        """Write byte by byte with pauses between."""
        ...

    def gather(self, duration_s: float, size: int | None = None) -> bytes:
        """Return all that comes in `duration_s`, or until `size` bytes are there."""
        ...


def questions(_scope: Scope, _clock: Clock) -> list[tuple[str, Callable[[], Asked]]]:
    """Return nothing: it is on serial ports only, which are asked for all makes."""
    return []


def knows(_port: SerialPort, _received: bytes) -> bool:
    """Return False: a Create sends nothing that differs from noise before it is asked."""
    return False


def ask_url(url: str, _clock: Clock) -> Asked:
    """Refuse a URL without a device; the others are asked as serial ports."""
    return Asked(url, problem="this names no serial port")


def ask_line(line: Port, port: SerialPort, baud: int, received: bytes, _clock: Clock) -> tuple[Found, ...]:
    """Return the robot on a claimed line at this rate."""
    robot = ask(line, port.path, baud, received)
    return () if robot is None else (robot,)


def ask(line: Port, path: str, baud: int, received: bytes) -> Found | None:
    """Return the robot on the line at this rate; None when no Open Interface answers there.

    Parameters
    ----------
    received
        What came before the question: a stream that was left running is paused and resumed.
    """
    streaming = bool(StreamParser(both_checksums=True).feed(received))
    asleep = modern = False
    line.spell(pause_stream(paused=True))
    line.gather(WAKE_S)
    try:
        mode = _mode(line)
        if mode is None:
            line.spell(simple(Op.START))
            line.gather(WAKE_S)
            mode = _mode(line)
            asleep = mode is not None
        sensors = None if mode is None else _query(line, CREATE1_GROUP)
        modern = sensors is not None and _query(line, ALL_GROUP) is not None
    finally:
        if asleep and modern:  # a Create 1 has no command for it; it falls asleep after five minutes
            line.spell(simple(Op.STOP))
        if streaming:
            line.spell(pause_stream(paused=False))
    if mode is None or sensors is None or not _plausible(sensors):
        return None
    return _found(path, CREATE2 if modern else CREATE1, baud, sensors, mode, asleep=asleep)


def _found(path: str, generation: Generation, baud: int, sensors: Sensors, mode: int, *, asleep: bool) -> Found:
    # Just woken it is in Passive mode, whatever it calls that; and there is no mode above Full.
    offset = int(mode > (Mode.PASSIVE if asleep else Mode.FULL))
    return Found(
        port=path,
        make="iRobot",
        model="Create 2 or Roomba 500/600" if generation is CREATE2 else generation.label,
        battery=sensors.battery,
        url=_url(path, generation, baud, mode_offset=offset),
        note=_note(sensors, Mode(mode - offset), asleep=asleep),
    )


def _mode(line: Port) -> int | None:
    answer = _answer(line, MODE)
    return answer[0] if answer is not None and answer[0] in MODES else None


def _query(line: Port, group: int) -> Sensors | None:
    answer = _answer(line, group)
    return None if answer is None else decode([group], answer)


def _answer(line: Port, number: int) -> bytes | None:
    """Return the answer to one query, exactly as long as it must be; a second try for a lost byte."""
    for _ in range(2):
        line.spell(query(number))
        answer = line.gather(ANSWER_S, SIZES[number])
        more = line.gather(WAKE_S)
        if len(answer + more) == SIZES[number]:
            return answer
    return None


def _plausible(sensors: Sensors) -> bool:
    """Tell noise from a robot: fields that can only have few values have one of them."""
    return (
        0 < (sensors.voltage_mv or 0) <= MOST_MV
        and (sensors.charging_state or 0) <= LAST_CHARGING_STATE
        and (sensors.song or 0) <= LAST_SONG
        and sensors.playing in (0, 1)
        and sensors.mode in MODES
    )


def _url(path: str, generation: Generation, baud: int, *, mode_offset: int) -> str:
    other_rate = "" if baud == generation.baud else f"&baud={baud}"
    quirk = f"&mode_offset={mode_offset}" if mode_offset else ""
    return f"create://{quote(path)}?model={generation.name}{other_rate}{quirk}"


def _note(sensors: Sensors, mode: Mode, *, asleep: bool) -> str:
    notes = ["it was off" if asleep else f"mode {mode.name}"]
    if sensors.chargers:
        notes.append("on the charger: it does not drive there")
    if sensors.wheel_drop:
        notes.append("a wheel hangs")
    return ", ".join(notes)
