"""Asks a serial port whether an e-puck2 is there: its version, in text, which moves nothing and means nothing to others."""

from collections.abc import Callable, Sequence

from fullswarm.clock import Clock
from fullswarm.drivers.make import Scope
from fullswarm.drivers.probe.found import Asked, Found
from fullswarm.drivers.probe.line import Line, SerialPort

LISTEN_S = 0.0
ANSWER_S = 0.3
QUESTION, GREETING = bytes(8) + b"V\rV\r", b"v,Version"
"""Twice: the zeros end a request in which other makes' questions may have begun, the first V a line of text."""
BAUD = 115200


def questions(_scope: Scope, _clock: Clock) -> Sequence[tuple[str, Callable[[], Asked]]]:
    """Return nothing: it is on serial ports only, which are asked for all makes."""
    return ()


def knows(_port: SerialPort, received: bytes) -> bool:
    """Tell an e-puck2 that greets: it has just been switched on."""
    return b"SerCom protocol on e-Puck" in received


def ask_url(url: str, _clock: Clock) -> Asked:
    """Refuse a URL without a device; the others are asked as serial ports."""
    return Asked(url, problem="this names no serial port")


def ask_line(line: Line, port: SerialPort, baud: int, _received: bytes, _clock: Clock) -> tuple[Found, ...]:
    """Return the robot on a claimed line at this rate."""
    if baud != BAUD:
        return ()
    line.send(QUESTION)
    text = line.gather(ANSWER_S)
    begin = text.find(GREETING)
    if begin < 0:
        return ()
    version = text[begin + 2 :].partition(b"\r")[0].decode("ascii", errors="replace")
    return (Found(port.path, "GCtronic", "e-puck2", version, url=f"epuck2://{port.path}"),)
