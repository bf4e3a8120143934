"""A trial as a film: GIF through pillow, MP4 (H.264) through ffmpeg."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError, FullswarmError, MissingExtra
from fullswarm.evaluate.pictures.scene import WIDTH_PX, Scene, palette
from fullswarm.evaluate.pictures.timeline import Timeline
from fullswarm.evaluate.trial_folder import Trajectory, whole_file

if TYPE_CHECKING:
    from PIL import Image as Images

FILM_ENDINGS = (".gif", ".mp4")
FASTEST_GIF_FPS = 50.0
"""A GIF counts hundredths of a second, and viewers slow down what is shorter than two."""
MOST_FRAMES = 20_000
MOST_GIF_PIXELS = 600_000_000
"""All frames of a GIF are in memory until it is written."""
HOLD_MS = 1000
"""The last frame of a GIF stands so much longer, before it begins anew."""
MARKED_S = 0.4
"""A contact is marked so long on the screen, however short it was."""

Progress = Callable[[int, int], None]
"""Called with the number of frames done, and of all."""
Frame = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Film:
    """How a trial is filmed.

    Attributes
    ----------
    speed : seconds of the trial in one second of the film
    fps : frames per second of the film
    from_s, until_s : part of the trial; None: from its start, until its end
    trail_s : how much of its way each robot draws behind it, of the trial's time
    """

    speed: float = 4.0
    fps: float = 10.0
    from_s: float | None = None
    until_s: float | None = None
    width_px: int = WIDTH_PX
    trail_s: float = 10.0
    caption: str = ""


def write_film(
    trajectory: Trajectory, path: Path, settings: Film | None = None, progress: Progress | None = None
) -> int:
    """Write a GIF or an MP4; return how many frames it has.

    Raises
    ------
    ConfigError
        Another ending, too many frames, nothing was recorded then, or the file cannot be written.
    MissingExtra
        matplotlib, pillow or imageio-ffmpeg is not installed.
    """
    kind, settings = path.suffix.lower(), settings or Film()
    if kind not in FILM_ENDINGS:
        raise ConfigError(f"a film ends in {' or '.join(FILM_ENDINGS)}", where=str(path))
    timeline = Timeline(trajectory)
    times_s = frame_times(timeline, settings)
    scene = Scene(timeline, settings.caption, settings.width_px)
    frames = _frames(scene, times_s, settings, progress)
    with whole_file(path) as beside:
        if kind == ".gif":
            _check_gif(scene, len(times_s), settings)
            _write_gif(beside, frames, len(times_s), settings.fps)
        else:
            _write_mp4(beside, frames, scene, len(times_s), settings.fps)
    return len(times_s)


def frame_times(timeline: Timeline, settings: Film) -> NDArray[np.float64]:
    """Return the trial's time (k,) in seconds of each frame; the last one shows the end.

    Raises
    ------
    ConfigError
        Speed or rate are not positive, or there would be more than `MOST_FRAMES`.
    """
    if not (settings.speed > 0.0 and settings.fps > 0.0):
        raise ConfigError("speed and frames per second must be positive", where="--speed, --fps")
    first_s, last_s = timeline.window(settings.from_s, settings.until_s)
    step_s = settings.speed / settings.fps
    count = math.ceil((last_s - first_s) / step_s - 1e-9) + 1
    if count > MOST_FRAMES:
        raise ConfigError(f"{count} frames are too many", where="--speed, --fps", hint=f"{MOST_FRAMES} at most")
    times_s: NDArray[np.float64] = np.minimum(first_s + step_s * np.arange(count), last_s)
    return times_s


def _frames(scene: Scene, times_s: NDArray[np.float64], settings: Film, progress: Progress | None) -> Iterator[Frame]:
    """Yield each frame (height, width, 3); the next one overwrites it."""
    marked_s = max(MARKED_S, 1.0 / settings.fps) * settings.speed
    for number, time_s in enumerate(times_s.tolist(), 1):
        scene.update(time_s, since_s=time_s - marked_s, trail_s=settings.trail_s)
        yield np.ascontiguousarray(scene.frame()[..., :3])
        if progress is not None:
            progress(number, len(times_s))


# ------------------------------------------------------------------------------------------------------- GIF
def _check_gif(scene: Scene, count: int, settings: Film) -> None:
    if settings.fps > FASTEST_GIF_FPS:
        raise ConfigError(
            f"a GIF has {FASTEST_GIF_FPS:g} frames per second at most", where="--fps", hint="or write an .mp4"
        )
    if count * scene.width_px * scene.height_px > MOST_GIF_PIXELS:
        raise ConfigError(
            f"{count} frames of {scene.width_px} x {scene.height_px} are too many for a GIF",
            hint="raise --speed, lower --fps or --width, or write an .mp4",
        )


def durations_ms(count: int, fps: float) -> list[int]:
    """Return how long each frame stands: whole hundredths of a second that drift from the rate by none in sum."""
    ends = [10 * round(100.0 * number / fps) for number in range(count + 1)]
    spans = [after - before for before, after in itertools.pairwise(ends)]
    return [*spans[:-1], spans[-1] + HOLD_MS]


def _write_gif(path: Path, frames: Iterator[Frame], count: int, fps: float) -> None:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtra("a GIF needs pillow", hint="pip install 'fullswarm[experiments]'") from error
    table = Image.new("P", (1, 1))
    table.putpalette(palette().tobytes())

    def indexed(frame: Frame) -> Images.Image:
        return Image.fromarray(frame).quantize(palette=table, dither=Image.Dither.NONE)

    pictures = (indexed(frame) for frame in frames)
    first = next(pictures)
    with path.open("wb") as file:  # pillow leaves it open when it is interrupted
        first.save(
            file,
            format="GIF",
            save_all=True,
            append_images=pictures,
            duration=durations_ms(count, fps),
            loop=0,
            optimize=True,  # what has not changed becomes transparent: less than half the size
            palette=palette().tobytes(),
        )


# ------------------------------------------------------------------------------------------------------- MP4
def _write_mp4(path: Path, frames: Iterator[Frame], scene: Scene, count: int, fps: float) -> None:
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise MissingExtra(
            "an MP4 needs imageio-ffmpeg", hint="pip install 'fullswarm[experiments]', or write a .gif"
        ) from error
    writer: Any = imageio_ffmpeg.write_frames(
        str(path),
        (scene.width_px, scene.height_px),
        fps=fps,
        codec="libx264",
        pix_fmt_in="rgb24",
        pix_fmt_out="yuv420p",
        quality=None,
        macro_block_size=2,
        ffmpeg_log_level="fatal",
        output_params=["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"],
    )
    try:
        writer.send(None)
        for frame in frames:
            writer.send(frame)
    except OSError as error:
        raise FullswarmError("ffmpeg ended before its time", hint="is the disk full?") from error
    finally:
        writer.close()
    _check_mp4(path, count)


def _check_mp4(path: Path, count: int) -> None:
    """Raise `FullswarmError` unless all frames can be read again: the writer does not report how ffmpeg ended."""
    import imageio_ffmpeg

    try:
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:  # no film at all
        written = 0
    if written != count:
        raise FullswarmError(f"ffmpeg wrote {written} of {count} frames", hint="is the disk full?")
