"""Reads and writes the file of a camera (TOML): its lens, where it hangs, the floor tags, and how well it all fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tomlkit
from pydantic import Field, ValidationError

from fullswarm.config.models import Section, TagNumber
from fullswarm.config.toml_errors import parse_toml, validated
from fullswarm.errors import ConfigError
from fullswarm.localization.camera.optics import Lens, Optics
from fullswarm.localization.camera.plan import FloorTag, TagPlan

Row = tuple[float, float, float]
CALIBRATE = "run `fullswarm track calibrate {what}` first"


class LensPart(Section):
    """``[lens]``: OpenCV's model; ``matrix`` are its rows, ``distortion`` is k1, k2, p1, p2, k3."""

    width_px: int = Field(ge=16, le=20_000)
    height_px: int = Field(ge=16, le=20_000)
    matrix: tuple[Row, Row, Row]
    distortion: tuple[float, float, float, float, float]
    rms_px: float = Field(ge=0.0)
    views: int = Field(ge=0)


class FloorTagPart(Section):
    """``[[floor.tag]]``: where a floor tag is."""

    tag: TagNumber
    x_m: float
    y_m: float
    heading_rad: float
    size_m: Annotated[float, Field(gt=0.0)]
    residual_mm: float = 0.0


class FloorPart(Section):
    """``[floor]``: where the camera hangs; ``rotation`` are the picture's right, down and ahead in the world."""

    position_m: Row
    rotation: tuple[Row, Row, Row]
    rms_px: float = Field(ge=0.0)
    rms_mm: float = Field(ge=0.0)
    tag: tuple[FloorTagPart, ...] = ()


class CameraFile(Section):
    """A camera as it was calibrated."""

    name: str
    lens: LensPart
    floor: FloorPart | None = None

    def lens_of(self, size_px: tuple[int, int], where: str) -> Lens:
        """Return the lens for pictures of a size.

        Raises
        ------
        ConfigError
            They have another shape than those of the calibration.
        """
        part = self.lens
        if abs(size_px[0] * part.height_px - size_px[1] * part.width_px) > 0.01 * size_px[0] * part.height_px:
            raise ConfigError(
                f"the pictures are {size_px[0]} x {size_px[1]}, the calibration is for {part.width_px} x "
                f"{part.height_px}", where=where, hint="set the camera to that shape, or calibrate its lens again",
            )  # fmt: skip
        lens = Lens(
            (part.width_px, part.height_px), np.array(part.matrix), np.array(part.distortion), part.rms_px, part.views
        )
        return lens if size_px == lens.size_px else lens.scaled(size_px)

    def optics(self, size_px: tuple[int, int], where: str) -> Optics:
        """Return what turns pixels of pictures of a size into places.

        Raises
        ------
        ConfigError
            The floor is not calibrated, or the pictures have another shape.
        """
        if self.floor is None:
            raise ConfigError("has a lens but no floor", where=where, hint=CALIBRATE.format(what="floor"))
        floor = self.floor
        sigma_m = max(0.002, floor.rms_mm / 1000.0)
        return Optics(self.lens_of(size_px, where), np.array(floor.rotation), np.array(floor.position_m), sigma_m)

    def with_floor_tags(self, plan: TagPlan) -> TagPlan:
        """Return a plan whose floor tags are those of the calibration."""
        tags = () if self.floor is None else self.floor.tag
        floor = {each.tag: FloorTag(each.tag, each.x_m, each.y_m, each.heading_rad, each.size_m) for each in tags}
        return replace(plan, floor=floor)


def read_camera(path: Path) -> CameraFile:
    """Read a camera's file.

    Raises
    ------
    ConfigError
        It is not there, or wrong.
    """
    try:
        text = path.read_text("utf-8")
    except FileNotFoundError:
        raise ConfigError("no such file", where=str(path), hint=CALIBRATE.format(what="lens")) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path)) from None
    try:
        return validated(CameraFile, parse_toml(text, str(path)))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(each) for each in first["loc"])
        raise ConfigError(f"{key}: {first['msg']}", where=str(path), hint="calibrate again") from None


def write_camera(file: CameraFile, path: Path) -> None:
    """Write a camera's file; ``ConfigError`` if it cannot be written."""
    document = tomlkit.document()
    document.add(tomlkit.comment("Written by `fullswarm track calibrate`; metres, radians, pixels."))
    for key, value in file.model_dump(mode="json", exclude_none=True).items():
        document.add(key, value)
    try:
        path.write_text(tomlkit.dumps(document), "utf-8")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
