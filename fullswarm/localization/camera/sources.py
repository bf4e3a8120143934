"""Where pictures come from: devices, streams, video files, folders of pictures.

    v4l2:///dev/video0?width=1920&height=1080&fps=30     a camera of this computer; exposure_us=4000, gain=… as well
    rtsp://…  http://…  https://…                        a stream
    PATH                                                 a video, a picture, or a folder of pictures

A live source has one thread that only receives; it keeps the newest picture and opens the source again when it is lost.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from fullswarm.clock import Clock
from fullswarm.errors import ConfigError, DriverError, did_you_mean
from fullswarm.localization.camera.finder import Grey
from fullswarm.localization.camera.optics import opencv
from fullswarm.runtime import Mailbox

STREAMS = ("rtsp", "rtsps", "http", "https")
DEVICE = "v4l2"
DEVICE_SETTINGS = ("width", "height", "fps", "exposure_us", "gain", "focus", "fourcc")
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm")
OPEN_MS = READ_MS = 3000
AGAIN_S = 1.0
LATEST_S = 1.0
"""A device's time stamp that is older than this, or of the future, is of another clock."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A picture.

    Parameters
    ----------
    grey : (h, w)
    time_s : when it was exposed: on this machine's clock, or of the video
    """

    grey: Grey
    time_s: float
    number: int = 0


def is_live(source: str) -> bool:
    """Return whether a source is a device or a stream."""
    return urlsplit(source).scheme in (*STREAMS, DEVICE)


def shown(source: str) -> str:
    """Return a source without a password."""
    parts = urlsplit(source)
    if parts.password is None:
        return source
    return source.replace(f":{parts.password}@", ":…@", 1)


def grey_of(cv2: Any, picture: Any) -> Grey:
    """Return a picture, (h, w) or (h, w, 3), as grey."""
    grey: Grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    return grey


def recorded(source: str) -> Iterator[Shot]:
    """Yield all pictures of a video, a picture or a folder.

    Raises
    ------
    ConfigError
        There is no such file, or it has no picture that can be read.
    """
    cv2 = opencv()
    path = Path(source.removeprefix("file://"))
    if not path.exists():
        raise ConfigError(
            "no such file or folder", where=str(path), hint="a video, a picture, a folder of pictures, or a URL"
        )
    if path.is_dir() or path.suffix.lower() in PICTURES:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        pictures = [each for each in files if each.suffix.lower() in PICTURES]
        if not pictures:
            raise ConfigError("has no pictures", where=str(path), hint=f"files that end in {', '.join(PICTURES)}")
        for number, each in enumerate(pictures):
            grey = cv2.imread(str(each), cv2.IMREAD_GRAYSCALE)
            if grey is None:
                raise ConfigError("is no picture that can be read", where=str(each))
            yield Shot(grey, float(number), number)
        return
    capture = cv2.VideoCapture(str(path))
    try:
        rate_hz = capture.get(cv2.CAP_PROP_FPS) or 30.0
        number = 0
        while True:
            taken, picture = capture.read()
            if not taken:
                break
            yield Shot(grey_of(cv2, picture), number / rate_hz, number)
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise ConfigError("is no video that can be read", where=str(path))


class LiveSource:
    """A device or a stream, open again and again until it is closed.

    Parameters
    ----------
    on_shot : called on the mailbox's thread with the newest picture
    rate_hz : pictures beyond are left out
    latency_s : from the exposure to the arrival, where the source states no time

    Attributes
    ----------
    problem : why there is no picture; empty: there is

    Raises
    ------
    ConfigError
        The URL is malformed.
    """

    def __init__(
        self, source: str, clock: Clock, mailbox: Mailbox, on_shot: Callable[[Shot], None], *,
        rate_hz: float = 20.0, latency_s: float = 0.0,
    ) -> None:  # fmt: skip
        self._cv2 = opencv()
        self._source, self._clock, self._mailbox, self._on_shot = source, clock, mailbox, on_shot
        self._period_s, self._latency_s = 1.0 / rate_hz, latency_s
        self._device = device_settings(source) if urlsplit(source).scheme == DEVICE else None
        self.problem = f"no picture yet from {shown(source)}"
        self._newest: Shot | None = None
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._number = 0
        self._thread = threading.Thread(target=self._receive, name="camera", daemon=True)

    def start(self) -> None:
        """Receive from now on."""
        self._thread.start()

    def close(self) -> None:
        """Stop receiving; a stream that hangs is left to its time limit."""
        self._closing.set()
        self._thread.join(OPEN_MS / 1000.0)

    def _receive(self) -> None:
        while not self._closing.is_set():
            try:
                capture = self._open()
            except DriverError as error:
                self.problem = str(error)
            else:
                self._read(capture)
                capture.release()
                if not self._closing.is_set():
                    self.problem = f"{shown(self._source)} is lost; it is opened again"
            self._closing.wait(AGAIN_S)

    def _open(self) -> Any:
        cv2 = self._cv2
        if self._device is not None:
            path, settings = self._device
            capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
            _set_device(cv2, capture, settings)
        else:
            limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_MS]
            capture = cv2.VideoCapture(self._source, cv2.CAP_FFMPEG, limits)
        if not capture.isOpened():
            hint = "is it connected, and does no other program use it?" if self._device else "is its address right?"
            raise DriverError("cannot be opened; it is tried again", where=shown(self._source), hint=hint)
        return capture

    def _read(self, capture: Any) -> None:
        due_s = self._clock.now_s()
        while not self._closing.is_set() and capture.grab():
            now_s = self._clock.now_s()
            if now_s < due_s - 0.25 * self._period_s:
                continue  # fetched, so that no old picture waits in the driver, but not decoded
            due_s = max(due_s + self._period_s, now_s)
            taken, picture = capture.retrieve()
            if not taken:
                return
            self._number += 1
            shot = Shot(grey_of(self._cv2, picture), self._exposed_s(capture, now_s), self._number)
            with self._lock:
                waiting, self._newest = self._newest is not None, shot
            self.problem = ""
            if not waiting:
                self._mailbox.put(self._deliver, None)

    def _exposed_s(self, capture: Any, now_s: float) -> float:
        """Return when a picture was taken: V4L2 states it on the machine's monotonic clock."""
        if self._device is not None:
            stated_s = capture.get(self._cv2.CAP_PROP_POS_MSEC) / 1000.0
            if 0.0 <= now_s - stated_s < LATEST_S:
                return float(stated_s)
        return now_s - self._latency_s

    def _deliver(self, _: object) -> None:
        with self._lock:
            shot, self._newest = self._newest, None
        if shot is not None:
            self._on_shot(shot)


def device_settings(source: str) -> tuple[str, dict[str, str]]:
    """Return the device of a ``v4l2`` URL and its settings.

    Raises
    ------
    ConfigError
        It names no device, or a setting that there is not.
    """
    parts = urlsplit(source)
    if not parts.path.startswith("/"):
        raise ConfigError("names no device", where=source, hint="v4l2:///dev/video0")
    settings = dict(parse_qsl(parts.query, keep_blank_values=True))
    for key, text in settings.items():
        if key not in DEVICE_SETTINGS:
            raise ConfigError(f"unknown setting '{key}'", where=source, hint=did_you_mean(key, DEVICE_SETTINGS))
        if key != "fourcc" and not text.isdecimal():
            raise ConfigError(f"'{text}' is not a whole number", where=f"{source}: {key}")
        if key == "fourcc" and len(text) != 4:
            raise ConfigError("four characters, such as MJPG", where=f"{source}: fourcc")
    return parts.path, settings


def _set_device(cv2: Any, capture: Any, settings: dict[str, str]) -> None:
    # The format first: most devices give large pictures at a good rate as MJPG only.
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.get("fourcc", "MJPG")))
    numbers = {"width": cv2.CAP_PROP_FRAME_WIDTH, "height": cv2.CAP_PROP_FRAME_HEIGHT, "fps": cv2.CAP_PROP_FPS,
               "gain": cv2.CAP_PROP_GAIN}  # fmt: skip
    for key, code in numbers.items():
        if key in settings:
            capture.set(code, int(settings[key]))
    if "exposure_us" in settings:
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)  # V4L2: manual
        capture.set(cv2.CAP_PROP_EXPOSURE, int(settings["exposure_us"]) / 100.0)  # in units of 100 µs
    if "focus" in settings:
        capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)
        capture.set(cv2.CAP_PROP_FOCUS, int(settings["focus"]))
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
