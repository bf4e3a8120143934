"""Where a latched e-stop outlives its agent: one small file per robot, there while the latch is on."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import msgspec
import structlog

from fullswarm.messages import EStop

log = structlog.get_logger()


class LatchFolder:
    """Files ``<robot>.estop``. What is in them is for people; that a file is there is the latch.

    So a file that was cut short by a power loss, or that cannot be read, still holds the robot.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def holds(self, robot: str) -> bool:
        """Tell whether `robot` was latched and never released; when in doubt it was."""
        try:
            self._file(robot).stat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            log.error("cannot tell whether its e-stop was latched: it is taken for so", robot=robot, error=str(error))
        return True

    def engage(self, robot: str, order: EStop) -> None:
        """Write the file and wait for the disk: pulling the battery is what comes next after an e-stop."""
        text = {"id": order.id, "source": order.source, "reason": order.reason}
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with self._file(robot).open("wb") as file:
                file.write(msgspec.json.encode(text) + b"\n")
                file.flush()
                os.fsync(file.fileno())
            self._sync()
        except OSError as error:
            log.error("a restart of this agent would not know of the e-stop", robot=robot, error=str(error))

    def release(self, robot: str) -> None:
        """Take the file away."""
        try:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                self._file(robot).unlink()
                self._sync()
        except OSError as error:
            log.error("a restart of this agent would engage the e-stop again", robot=robot, error=str(error))

    def _file(self, robot: str) -> Path:
        return self._folder / f"{robot}.estop"

    def _sync(self) -> None:
        """Have the names on the disk too."""
        folder = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
