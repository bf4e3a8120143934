"""GNSS receivers as a source: NMEA 0183 and u-blox UBX over serial, TCP, UDP or from a file, in the swarm's frame.

The messages are parsed by `pynmeagps` and `pyubx2`. Positions come from UBX NAV-HPPOSLLH or NAV-PVT, else from NMEA GGA
with the errors of GST; headings of receivers with two antennas from UBX NAV-RELPOSNED, else from NMEA HDT or THS. A
receiver with one antenna gives no heading: the pose filter finds it as the robot drives. Corrections (`corrections.py`)
are written to the receiver's own port.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import unquote_plus

from fullswarm.clock import Clock
from fullswarm.earth import TangentPlane
from fullswarm.errors import ConfigError, MissingExtra, did_you_mean
from fullswarm.geometry import wrap
from fullswarm.localization.corrections import EXAMPLE, CorrectionFeed, options_of, take_corrections
from fullswarm.localization.links import SerialStream, byte_link
from fullswarm.localization.ntrip import Place
from fullswarm.localization.rtcm import Outbox
from fullswarm.localization.sighting import UNSEEN_RAD, Refused, Sighting
from fullswarm.localization.source import Limited, Receiver, Seen, Settings, Trouble

DAY_S, WEEK_S = 86_400.0, 604_800.0
KEPT_S = 1.5
"""An error estimate, a heading or a better kind of message counts for so long, by the receiver's time."""
LONGEST_NMEA, LONGEST_UBX = 256, 8192
SIGMA_M = {1: 2.5, 2: 1.0, 3: 2.5, 4: 0.02, 5: 0.4}
"""Standard deviation at HDOP 1 of GGA's qualities: autonomous, differential, PPS, RTK fixed, RTK float."""
NAMES = {1: "autonomous", 2: "differential", 3: "PPS", 4: "RTK fixed", 5: "RTK float"}
NO_POSITION = {0: "no position", 6: "dead reckoning", 7: "entered by hand", 8: "simulated"}
DIFFERENTIAL, FLOAT, FIXED = 0, 1, 2
QUALITY = {1: 0.5, 2: 0.7, 3: 0.5, 4: 1.0, 5: 0.8}
PYTHON = ("pynmeagps", "pyubx2")


@dataclass(frozen=True, slots=True)
class Mount:
    """How the antennas are mounted, and what is good enough.

    Parameters
    ----------
    forward_m, left_m : place of the antenna from the robot's centre
    baseline_rad : direction from the first to the second antenna in the robot's frame, counter-clockwise from forward
    worst_m : a position with a larger standard deviation is not used
    """

    forward_m: float = 0.0
    left_m: float = 0.0
    baseline_rad: float = 0.0
    worst_m: float = 1.0


class Splitter:
    """Splits a receiver's bytes into NMEA sentences and UBX frames; what is neither, such as RTCM, is skipped."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the messages that are complete now."""
        self._buffer += data
        found: list[bytes] = []
        while self._buffer:
            size = self._size()
            if size is None:
                break
            if size > 0:
                found.append(bytes(self._buffer[:size]))
            del self._buffer[: abs(size)]
        return found

    def _size(self) -> int | None:
        """Return the length of the message at the front; negative: of what is to be skipped; None: more is needed."""
        buffer = self._buffer
        if buffer[0] == 0x24:  # $
            end = buffer.find(b"\n", 0, LONGEST_NMEA)
            if end >= 0:
                return end + 1
            return None if len(buffer) < LONGEST_NMEA else -1
        if buffer[0] == 0xB5:
            if len(buffer) < 6:
                return None if len(buffer) < 2 or buffer[1] == 0x62 else -1
            length = 8 + int.from_bytes(buffer[4:6], "little")
            if buffer[1] != 0x62 or length > LONGEST_UBX:
                return -1
            return length if len(buffer) >= length else None
        starts = [at for at in (buffer.find(b"$"), buffer.find(b"\xb5")) if at >= 0]
        return -min(starts) if starts else -len(buffer)


class Decoder:
    """Turns a receiver's messages into sightings of one robot.

    Parameters
    ----------
    robot : whose receiver it is

    Attributes
    ----------
    place : where the receiver was last, however uncertain; None: it has not had a position yet
    """

    def __init__(self, robot: str, plane: TangentPlane, mount: Mount) -> None:
        self._robot, self._plane, self._mount = robot, plane, mount
        self._splitter = Splitter()
        self._heading: tuple[float, float, float] | None = None  # rad, sigma, time
        self._errors: tuple[float, float, float] | None = None  # east, north (m), time
        self._carrier: tuple[int, float] = (DIFFERENTIAL, -math.inf)  # of NAV-PVT, and its time
        self._ubx_s = self._precise_s = -math.inf
        self._last_s, self._turns = -math.inf, 0
        self.place: Place | None = None
        self._handlers: dict[str, Callable[[Any], Iterable[Seen]]] = {
            "NAV-PVT": self._nav_pvt, "NAV-HPPOSLLH": self._nav_hpposllh, "NAV-RELPOSNED": self._nav_relposned,
            "GGA": self._gga, "GST": self._gst, "HDT": self._hdt, "THS": self._ths,
        }  # fmt: skip

    def read(self, data: bytes) -> list[Seen]:
        """Return what the messages in these bytes say."""
        found: list[Seen] = []
        for message in self._splitter.feed(data):
            try:
                found += self._message(message)
            except Refused as refused:
                found.append(refused)
        return found

    def _message(self, message: bytes) -> list[Seen]:
        from pynmeagps import NMEAReader
        from pyubx2 import UBXReader

        try:
            parsed: Any = NMEAReader.parse(message) if message[:1] == b"$" else UBXReader.parse(message)
        except Exception as error:  # whatever the parsers raise: a receiver's bytes may be damaged
            raise Refused("a message that cannot be read", f"{type(error).__name__}: {error}"[:100]) from None
        if parsed is None:
            raise Refused("a message that cannot be read", "not text")
        handler = self._handlers.get(str(getattr(parsed, "msgID", parsed.identity)))
        try:
            return list(handler(parsed)) if handler is not None else []
        except (AttributeError, TypeError, ValueError) as error:
            raise Refused(f"a message {parsed.identity} without its fields", str(error)[:100]) from None

    # ------------------------------------------------------------------ UBX
    def _nav_pvt(self, pvt: Any) -> Iterable[Seen]:
        now_s = self._week(pvt.iTOW)
        self._ubx_s = now_s
        if not pvt.gnssFixOk or pvt.fixType not in (2, 3, 4):
            self._carrier = (DIFFERENTIAL, -math.inf)
            yield Trouble("the GNSS receiver has no position: can its antenna see the sky?")
            return
        self._carrier = (int(pvt.carrSoln), now_s)
        self._note_place(
            3600.0 * pvt.hour + 60.0 * pvt.min + pvt.second, (pvt.lat, pvt.lon), pvt.hMSL / 1000.0,
            (pvt.height - pvt.hMSL) / 1000.0, self._quality(), pvt.numSV, pvt.pDOP,
        )  # fmt: skip
        if now_s - self._precise_s > KEPT_S:
            yield self._position(pvt.lat, pvt.lon, (pvt.hAcc / 1000.0,), self._quality(), now_s)

    def _nav_hpposllh(self, place: Any) -> Iterable[Seen]:
        now_s = self._week(place.iTOW)
        if place.invalidLlh or now_s - self._carrier[1] > KEPT_S:
            return  # only NAV-PVT says whether there is a fix
        self._ubx_s = self._precise_s = now_s
        yield self._position(place.lat, place.lon, (place.hAcc / 1000.0,), self._quality(), now_s)

    def _nav_relposned(self, way: Any) -> Iterable[Seen]:
        now_s = self._week(way.iTOW)
        valid = way.relPosHeadingValid and way.gnssFixOK and way.carrSoln == FIXED
        self._heading = (self._of_compass(way.relPosHeading), math.radians(way.accHeading), now_s) if valid else None
        return ()

    def _quality(self) -> int:
        return {FLOAT: 5, FIXED: 4}.get(self._carrier[0], 2)

    # ------------------------------------------------------------------ NMEA
    def _gst(self, errors: Any) -> Iterable[Seen]:
        if not math.isfinite(self._ubx_s):  # then the time is not the day's but the week's
            self._errors = (float(errors.stdLong), float(errors.stdLat), self._day(errors.time))
        return ()

    def _hdt(self, compass: Any) -> Iterable[Seen]:
        if compass.headingT != "":
            self._heading = (self._of_compass(float(compass.headingT)), math.radians(0.5), self._last_s)
        return ()

    def _ths(self, compass: Any) -> Iterable[Seen]:
        if compass.headt != "" and compass.mi == "A":
            self._heading = (self._of_compass(float(compass.headt)), math.radians(0.5), self._last_s)
        return ()

    def _gga(self, place: Any) -> Iterable[Seen]:
        if math.isfinite(self._ubx_s):
            return  # the same receiver says it better
        quality = int(place.quality)
        if quality in NO_POSITION or place.lat == "" or place.lon == "" or place.time == "":
            why = NO_POSITION.get(quality, "no position")
            yield Trouble(f"the GNSS receiver has no measured position ({why}): can its antenna see the sky?")
            return
        now_s = self._day(place.time)
        self._note_place(
            now_s % DAY_S, (place.lat, place.lon), place.alt or 0.0, place.sep or 0.0, quality, place.numSV or 0,
            place.HDOP or 1.0,
        )  # fmt: skip
        if self._errors is not None and abs(now_s - self._errors[2]) < KEPT_S:
            sigmas_m: tuple[float, ...] = self._errors[:2]
        else:
            sigmas_m = (SIGMA_M.get(quality, 2.5) * float(place.HDOP or 1.0),)
        yield self._position(place.lat, place.lon, sigmas_m, quality, now_s)

    # ------------------------------------------------------------------ both
    def _note_place(
        self, day_s: float, at_deg: tuple[float, float], height_m: float, separation_m: float, quality: int,
        satellites: int, dop: float,
    ) -> None:  # fmt: skip
        """Keep where the receiver is, if that can be said in a sentence GGA."""
        latitude_deg, longitude_deg = float(at_deg[0]), float(at_deg[1])
        height_m, separation_m, dop = float(height_m), float(separation_m), float(dop)
        if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
            return
        if abs(height_m) < 1.0e5 and abs(separation_m) < 1.0e3 and 0.0 <= dop < 1.0e3 and 0.0 <= day_s < 2.0 * DAY_S:
            self.place = Place(
                day_s, latitude_deg, longitude_deg, height_m, separation_m, quality, min(int(satellites), 99), dop
            )

    def _position(
        self, latitude_deg: float, longitude_deg: float, sigmas_m: tuple[float, ...], quality: int, now_s: float
    ) -> Seen:
        sigma_m = max(sigmas_m)
        if not 0.0 < sigma_m <= self._mount.worst_m:
            kind = NAMES.get(quality, "")
            return Trouble(f"the position ({kind}) is known to {sigma_m:.2g} m only; worst_m={self._mount.worst_m:g}")
        x_m, y_m, _ = self._plane.enu(latitude_deg, longitude_deg)
        if math.hypot(x_m, y_m) > 1.0e5:
            return Trouble(f"the receiver is {math.hypot(x_m, y_m) / 1000.0:.0f} km from [world] origin: is it right?")
        heading_rad, sigma_rad = 0.0, UNSEEN_RAD
        forward_m, left_m = self._mount.forward_m, self._mount.left_m
        extra_m2 = 0.0
        if self._heading is not None and abs(now_s - self._heading[2]) < KEPT_S:
            heading_rad, sigma_rad, _ = self._heading
            cos, sin = math.cos(heading_rad), math.sin(heading_rad)
            x_m, y_m = x_m - cos * forward_m + sin * left_m, y_m - sin * forward_m - cos * left_m
        else:
            extra_m2 = forward_m * forward_m + left_m * left_m  # in which direction is not known
        east_m, north_m = sigmas_m[0], sigmas_m[-1]
        covariance_m2 = (east_m * east_m + extra_m2, 0.0, north_m * north_m + extra_m2)
        return Sighting(
            self._robot, x_m, y_m, heading_rad, math.sqrt(max(covariance_m2)), sigma_rad, now_s,
            covariance_m2=covariance_m2, quality=QUALITY.get(quality, 0.5), marker=NAMES.get(quality, "GNSS"),
        )  # fmt: skip

    def _of_compass(self, degrees: float) -> float:
        """Return the robot's heading of the direction of the antennas, which is clockwise from north."""
        return wrap(math.pi / 2.0 - math.radians(degrees) - self._mount.baseline_rad)

    def _week(self, time_ms: float) -> float:
        return self._steady(time_ms / 1000.0, WEEK_S)

    def _day(self, time: Any) -> float:
        seconds = 3600.0 * time.hour + 60.0 * time.minute + time.second + time.microsecond / 1e6
        return self._steady(seconds, DAY_S)

    def _steady(self, time_s: float, period_s: float) -> float:
        """Return a time that does not jump back where the receiver's begins anew."""
        now_s = time_s + self._turns * period_s
        if now_s < self._last_s - period_s / 2.0:
            self._turns += 1
            now_s += period_s
        self._last_s = now_s
        return now_s


def mount_of(options: dict[str, str], where: str) -> Mount:
    """Return the mount of a URL's options; raises `ConfigError`."""
    known = {"forward": "forward_m", "left": "left_m", "baseline_deg": "", "worst_m": "worst_m"}
    others = ("baud", "rtcm", "login")
    values: dict[str, float] = {}
    for key, text in options.items():
        if key not in known:
            raise ConfigError(f"unknown option '{key}'", where=where, hint=did_you_mean(key, (*known, *others)))
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not abs(value) <= 1000.0:
            raise ConfigError(f"'{text}' is no number of this size", where=f"{where}: {key}")
        if key == "baseline_deg":
            values["baseline_rad"] = math.radians(value)
        else:
            values[known[key]] = value
    return Mount(**values)


class GnssSource:
    """``gnss:///dev/ttyACM0[?baud=38400]``, ``gnss+tcp://HOST:PORT``, ``gnss+udp://HOST:PORT``, ``gnss+file:///PATH``.

    Further options of the URL: ``forward``, ``left`` (m), ``baseline_deg``, ``worst_m``, see :class:`Mount`; ``rtcm``
    and ``login``, see :mod:`fullswarm.localization.corrections`.

    Raises
    ------
    ConfigError
        No robot, no origin, or an option that is wrong.
    MissingExtra
        The parsers are not installed.
    """

    sensor = "gnss"
    hint = "is the receiver on, is the baud rate right, does it send NMEA GGA or UBX NAV-PVT?"

    def __init__(self, settings: Settings, clock: Clock) -> None:
        device = settings.url.partition("?")[0]
        if "rtcm=" in device or "login=" in device:
            hint = f"gnss:///dev/ttyACM0?{EXAMPLE}"
            raise ConfigError("options without '?' before them", where="source gnss", hint=hint)
        where = f"source {device}"  # options may have a password
        if missing := [each for each in PYTHON if importlib.util.find_spec(each) is None]:
            raise MissingExtra(f"`{missing[0]}` is not installed", hint="pip install 'fullswarm[gnss]'")
        if not settings.robot:
            raise ConfigError("a receiver measures one robot: which?", where=where, hint="--robot r1, or robot = 'r1'")
        if settings.origin_deg is None:
            hint = "[world] origin = [latitude, longitude] in the fleet file"
            raise ConfigError("where on earth the swarm's (0, 0) is, is not stated", where=where, hint=hint)
        options = options_of(settings.url)
        corrections = take_corrections(options, where)
        options = {key: unquote_plus(value) for key, value in options.items()}
        baud = options.pop("baud", "38400")
        self._decoder = Decoder(settings.robot, TangentPlane(*settings.origin_deg), mount_of(options, where))
        self._clock, self._limit, outbox = clock, "", Outbox()
        if corrections is not None and device.startswith(("gnss+udp:", "gnss+file:")):
            hint = "gnss:///dev/ttyACM0 or gnss+tcp://HOST:PORT"
            raise ConfigError("corrections cannot be sent to this receiver", where=where, hint=hint)
        self._link, self.address = byte_link(
            device, baud, clock, insecure_network=settings.insecure_network,
            serial=partial(SerialStream, outbox=outbox), outbox=outbox,
        )  # fmt: skip
        self._feed = None if corrections is None else CorrectionFeed(corrections, outbox, self._place, clock)

    def _place(self) -> Place | None:
        return self._decoder.place

    def start(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on."""
        self._link.start(receiver)
        if self._feed is not None:
            self._feed.start()

    def read(self, content: bytes) -> Iterable[Seen]:
        """Read on; say as well what the corrections lack."""
        found = self._decoder.read(content)
        limit = "" if self._feed is None else self._feed.trouble(self._clock.now_s())
        if limit != self._limit:
            self._limit = limit
            found.append(Limited(limit))
        return found

    def close(self) -> None:
        """Stop delivering."""
        if self._feed is not None:
            self._feed.close()
        self._link.close()
