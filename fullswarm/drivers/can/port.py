"""A CAN bus as a port: python-can, its exceptions turned into ours. One thread at a time."""

from __future__ import annotations

import select
import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from fullswarm.drivers.can import slcan
from fullswarm.drivers.can.protocol import MAX_DATA, Frame
from fullswarm.drivers.can.settings import Settings
from fullswarm.drivers.ports import Port, claim
from fullswarm.errors import DriverError, LinkLost, MissingExtra

if TYPE_CHECKING:
    import can
    import serial

SEND_TIMEOUT_S = 0.01
UNRECEIVED = 3
"""So many errors in a row mean that the bus is gone; a single one is a stray datagram."""
UNSENT = 10
"""So many mean that nothing is sent, whatever is received; an adapter's buffer may be full for some tens of ms."""
BACKLOG = 1000
"""Frames taken at most between two looks at what is due."""
BUS_OFF = 0x40
"""Class bit of an error frame (linux/can/error.h): the adapter has switched itself off."""


def _python_can() -> Any:
    try:
        import can
    except ImportError as error:
        raise MissingExtra(
            "a CAN base needs python-can", hint="install the extra: pip install 'fullswarm[can]'"
        ) from error
    return can


class CanPort(Port[Frame]):
    """An open bus.

    Raises
    ------
    MissingExtra
        python-can, or what it needs for this interface, is not installed.
    DriverError
        The interface cannot be opened; tells what to do.
    """

    def __init__(self, settings: Settings) -> None:
        library = _python_can()
        self._where = f"{settings.bus.interface} {settings.channel}"
        self._unsent = self._unreceived = 0  # counted apart: an adapter may receive well that sends nothing any more
        self.dropped = 0  # frames that could not be sent or understood
        # python-can's backends let all but the first slip through when a line of an adapter makes no sense.
        self._errors = (library.CanError, OSError, ValueError, LookupError, TypeError, struct.error)
        self._message = library.Message
        self._lost_state = library.BusState.ERROR
        self._claim: serial.Serial | None = None
        try:
            if settings.bus.interface == "slcan":
                self._bus: can.BusABC = self._open_serial(settings)
            else:
                self._bus = library.Bus(
                    channel=settings.channel,
                    interface=settings.bus.interface,
                    ignore_config=True,
                    **_interface_options(settings),
                )
        except library.CanInterfaceNotImplementedError as error:
            raise MissingExtra(str(error), where=self._where, hint="pip install 'fullswarm[can]'") from error
        except (library.CanError, OSError, ValueError) as error:
            self._let_go()
            cause = f" ({error.__cause__})" if error.__cause__ else ""
            raise DriverError(
                f"cannot open the bus: {error}{cause}", where=self._where, hint=_HINTS[settings.bus.interface]
            ) from error

        self._drained = True  # nothing more has been read than was returned
        try:
            self._descriptor: int | None = self._bus.fileno()
        except NotImplementedError:
            self._descriptor = None

    def _open_serial(self, settings: Settings) -> can.BusABC:
        """Claim the adapter's port, which python-can does not, before anything is sent there."""
        from fullswarm.drivers.can.slcan_bus import SlcanBus

        bus = settings.bus
        self._claim = claim(settings.channel, bus.tty_baud)
        return SlcanBus(
            settings.channel, bitrate=settings.bitrate, tty_baudrate=bus.tty_baud, sleep_after_open=bus.settle
        )

    def _let_go(self) -> None:
        port, self._claim = self._claim, None
        if port is not None:
            port.close()

    def fileno(self) -> int | None:
        """Return what to wait on; None: there is no such thing (``virtual``)."""
        return self._descriptor

    @property
    def guardable(self) -> int | None:
        """The descriptor on which a guardian can send."""
        # Of an adapter the claim, because it is what keeps other programs from the port.
        return self._descriptor if self._claim is None else int(self._claim.fileno())

    @property
    def destination(self) -> tuple[str, int] | None:
        """Where frames must be sent to on :attr:`guardable`; None: it is connected."""
        multicast = getattr(self._bus, "_multicast", None)
        return None if multicast is None else (str(multicast.group), int(multicast.port))

    def packed(self, chunk: Frame) -> bytes:
        """Return a frame as it has to be written to :attr:`guardable`."""
        if self._claim is not None:
            return slcan.END + slcan.encode(chunk)  # ends a line that was cut in two
        message = self._packable(chunk)
        if self.destination is not None:
            from can.interfaces.udp_multicast.utils import pack_message

            return bytes(pack_message(message))
        from can.interfaces.socketcan.socketcan import build_can_frame

        return bytes(build_can_frame(message))

    def read(self) -> Sequence[Frame]:
        """Return all that has arrived: after a pause no wheel may count as silent whose frames wait in the port."""
        frames: list[Frame] = []
        while len(frames) < BACKLOG and (frame := self.receive(0.0)) is not None:
            frames.append(frame)
        return frames

    def write(self, chunk: Frame) -> None:
        """Send a frame, or lose it."""
        self.send(chunk)

    def send(self, frame: Frame) -> None:
        """Send `frame`, waiting at most 10 ms.

        Raises
        ------
        LinkLost
            The tenth error in a row.
        """
        try:
            self._bus.send(self._packable(frame), timeout=SEND_TIMEOUT_S)
        except self._errors as error:
            self._unsent += 1
            self._failed(f"cannot send: {error}", error, over=self._unsent >= UNSENT)
        else:
            self._unsent = 0

    def _packable(self, frame: Frame) -> can.Message:
        message: can.Message = self._message(
            arbitration_id=frame.id,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            data=None if frame.remote else frame.data,
            dlc=MAX_DATA if frame.remote else len(frame.data),
        )
        return message

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, None when none came in time.

        python-can measures a wait by the wall clock: set back, it lasts an hour. So the kernel waits here wherever
        a bus has a file descriptor (all but ``virtual``).

        Raises
        ------
        LinkLost
            The adapter went bus-off, or the third error in a row.
        """
        timeout_s = max(0.0, timeout_s)
        try:
            if not self._worth_reading(timeout_s):
                return None
            message = self._bus.recv(timeout=timeout_s if self._descriptor is None else 0.0)
        except self._errors as error:
            self._unreceived += 1
            self._failed(f"cannot receive: {error}", error, over=self._unreceived >= UNRECEIVED)
            return None
        self._drained = message is None
        if message is None:
            return None
        if message.is_error_frame:
            self._on_error_frame(message.arbitration_id)
            return None
        self._unreceived = 0
        if message.is_fd:
            return None
        return Frame(message.arbitration_id, message.is_extended_id, bytes(message.data), message.is_remote_frame)

    def _worth_reading(self, timeout_s: float) -> bool:
        """Wait until something has arrived, where the kernel shows it."""
        if self._descriptor is None or not self._drained:
            return True
        return bool(select.select([self._descriptor], [], [], timeout_s)[0])

    def _on_error_frame(self, error_class: int) -> None:
        self.dropped += 1
        if error_class & BUS_OFF or self._bus.state is self._lost_state:
            raise LinkLost(
                "the CAN adapter went bus-off",
                where=self._where,
                hint="check bitrate, wiring and the two 120 ohm terminators",
            )

    def _failed(self, what: str, error: Exception, *, over: bool) -> None:
        self.dropped += 1
        if over:
            hint = "is the adapter plugged in, are the controllers powered?"
            raise LinkLost(what, where=self._where, hint=hint) from error

    def close(self) -> None:
        """Let go of the bus; an adapter that is already gone is no error."""
        try:
            self._bus.shutdown()
        except self._errors:
            self.dropped += 1
            # slcan first closes the adapter's channel; when that fails it leaves the serial port open.
            serial_port = getattr(self._bus, "serialPortOrig", None)
            if serial_port is not None:
                serial_port.close()
        finally:
            self._let_go()


_HINTS = {
    "socketcan": "bring the interface up: ip link set can0 up type can bitrate 250000",
    "slcan": "check the device name, and that you may open it (group dialout)",
    "virtual": "the name of a virtual channel is any word",
    "udp_multicast": "the channel is a multicast group such as 239.74.163.2, and it needs a route: "
    "without a network, ip route add 239.0.0.0/8 dev lo",
}


def _interface_options(settings: Settings) -> dict[str, Any]:
    bus = settings.bus
    options: dict[str, dict[str, Any]] = {
        "udp_multicast": {"port": bus.port, "hop_limit": bus.hop_limit},
    }
    return options.get(bus.interface, {})
