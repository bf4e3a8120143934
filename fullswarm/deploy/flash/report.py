"""Reads what the first boot has left on a card: ``fullswarm flash --report``."""

from __future__ import annotations

import os
from pathlib import Path

from fullswarm import output
from fullswarm.deploy.flash import mtools
from fullswarm.deploy.flash.fat import boot_volume
from fullswarm.deploy.flash.payload import FOLDER, REPORT
from fullswarm.deploy.flash.write import explain
from fullswarm.errors import ConfigError

OK = ": OK"


def run(place: Path, *, as_json: bool) -> int:
    """Print the report of a card, an image, or a folder where the boot partition is mounted; 1: it is no success.

    Raises
    ------
    ConfigError
        It cannot be read, or holds no report.
    """
    text = read(place)
    good = text.splitlines()[0].endswith(OK) if text else False
    if as_json:
        output.data_json({"place": str(place), "ok": good, "report": text})
    else:
        output.data(text.rstrip())
    return 0 if good else 1


def read(place: Path) -> str:
    """Return the report's text.

    Raises
    ------
    ConfigError
        It cannot be read, or holds no report; says what that means.
    """
    if place.is_dir():
        content, ours = _from_folder(place)
    else:
        content, ours = _from_disk(place)
    if content is None and not ours:
        hint = "is it the right card? `lsblk` shows what is there"
        raise ConfigError("was not written by fullswarm", where=str(place), hint=hint)
    if content is None:
        hint = (
            "power (a good supply, its LED), the right board for this image, the card fully pushed in; "
            "a screen shows how far it gets"
        )
        raise ConfigError("no report: the robot has not come as far as its first boot", where=str(place), hint=hint)
    return content.decode("utf-8", "replace")


def _from_folder(folder: Path) -> tuple[bytes | None, bool]:
    file = folder / REPORT
    return (file.read_bytes() if file.is_file() else None), (folder / FOLDER).is_dir()


def _from_disk(disk: Path) -> tuple[bytes | None, bool]:
    try:
        number = os.open(disk, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise explain(error, disk, 0) from error
    try:
        volume = boot_volume(number, str(disk))
    finally:
        os.close(number)
    return mtools.get(disk, volume, REPORT), mtools.get(disk, volume, f"{FOLDER}/card.env") is not None
