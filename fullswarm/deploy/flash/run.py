"""Runs `fullswarm flash`: checks everything, asks, writes, reads back, pins host keys, waits for the robots."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from rich.markup import escape

from fullswarm import output
from fullswarm.config import RobotConfig
from fullswarm.deploy.flash import card, fat, image, wifi
from fullswarm.deploy.flash.card import Card
from fullswarm.deploy.flash.fat import Volume, boot_volume
from fullswarm.deploy.flash.payload import BootPartition, Shipment, Surroundings, boot_files
from fullswarm.deploy.flash.plan import (
    CardResult,
    FlashRequest,
    confirm_loss,
    details_of,
    prepare,
    read_head,
    release_for,
    robots_of,
)
from fullswarm.deploy.flash.result import ADVICE, FirstReport, check_hub_answers, wait_for_robots
from fullswarm.deploy.flash.write import CardFailed, Job, Outcome, explain, write_jobs
from fullswarm.deploy.fleet.login import Pins, known_hosts_name
from fullswarm.deploy.fleet.releases import extras_needed
from fullswarm.deploy.release.keys import Keys, public
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.files import replace_file
from fullswarm.identity.private import usable
from fullswarm.operator import session

PROGRESS_S = 2.0


def run(request: FlashRequest) -> int:
    """Flash cards; return 0, or 1 when a card failed.

    Raises
    ------
    ConfigError
        The request is wrong; nothing has been written then.
    Unreachable
        All cards are written, but a robot did not report within the time to wait.
    """
    keys = Keys.default()
    try:
        with usable(keys.folder):
            return _run(request, keys)
    finally:
        _hand_over(keys.folder)


def _run(request: FlashRequest, keys: Keys) -> int:
    config = load_fleet(request.fleet)
    robots = robots_of(config, request.robots)
    targets = _targets(request, robots)
    fat.check_tools()
    networks, country = wifi.gather(request.wifi_file, request.wifi, request.country, _ask_passphrase)
    around = Surroundings(config, networks, country, request.static, request.full_sudo)
    extras = frozenset().union(*(extras_needed(each, config) for each in robots))
    shipment = release_for(request.release, request.target, request.image, keys, extras)
    output.progress(f"release {shipment.id}: signature good, {len(shipment.body) / 1e6:.1f} MB on the card")
    hub = session.Target(request.hub or config.hub.endpoint, config.swarm)
    if request.wait_minutes is not None and not request.dry_run:
        check_hub_answers(hub)  # before a byte is written
    with provisional_host_keys(robots, config.swarm, keys) as begin:
        work = _configure if request.seed_only else _flash
        lines = work(request, robots, targets, around, keys, shipment, begin)
    if request.dry_run:
        return _show(request, lines, {})
    good = [line.robot for line in lines if not line.state.startswith("FAILED")]
    for robot in robots:
        if robot.id in good and pin_host_key(robot, config.swarm, keys):
            output.progress(f"{robot.id}: another host key was pinned at its address; it was removed")
    if request.wait_minutes is None or not good:
        return _show(request, lines, {})
    return _wait(request, lines, hub, good, request.wait_minutes)


def _wait(
    request: FlashRequest, lines: Sequence[CardResult], hub: session.Target, robots: Sequence[str], minutes: float
) -> int:
    """Wait for the robots; print the result before it, or at the end as one JSON document, whatever comes of it."""
    code = 0 if request.as_json else _show(request, lines, {})
    reported: dict[str, FirstReport] = {}
    try:
        reported, silent = wait_for_robots(hub, robots, minutes)
    finally:
        if request.as_json:
            code = _show(request, lines, reported)
    if silent:
        what = f"no report within {minutes:g} minutes"
        raise Unreachable(what, where=", ".join(silent), hint=ADVICE)
    return code


def _hand_over(folder: Path) -> None:
    """Give files that root has made among a user's keys to that user, whose next command runs without sudo."""
    user = int(os.environ.get("SUDO_UID") or "0")
    if os.geteuid() != 0 or not user:
        return
    line = (folder, *folder.parents)
    own = next((each for each in line if each.exists() and each.stat().st_uid == user), None)
    if own is None or not folder.exists():  # the keys are root's own, or none were made
        return
    for each in (*line[: line.index(own)], *folder.rglob("*")):
        if each.lstat().st_uid == 0:
            os.lchown(each, user, own.stat().st_gid)


def _targets(request: FlashRequest, robots: Sequence[RobotConfig]) -> tuple[Card | Path, ...]:
    if bool(request.devices) == bool(request.outputs):
        hint = "--device /dev/sdX for a card, or --output FILE for an image"
        raise ConfigError("name either devices or files to write", where="flash", hint=hint)
    count = len(request.devices or request.outputs)
    if count != len(robots):
        hint = "one --device or --output per robot, in the same order"
        raise ConfigError(f"{len(robots)} robots, but {count} cards", where="flash", hint=hint)
    if request.image is None and not request.seed_only:
        hint = "--image raspios.img.xz, or --seed-only for a card that was written before"
        raise ConfigError("no image given", where="--image", hint=hint)
    if request.devices:
        cards = card.choose(card.list_cards(), request.devices, request.most_bytes)
        for each in cards:  # before the image is read and the serial number typed
            if Path(each.path).exists() and not os.access(each.path, os.R_OK | os.W_OK):
                raise explain(PermissionError(errno.EACCES, os.strerror(errno.EACCES)), Path(each.path), 0)
        return cards
    if len(set(request.outputs)) != count:
        raise ConfigError("a file is named twice", where="--output", hint="one per robot")
    for path in request.outputs:
        _check_output(path, seed_only=request.seed_only)
    return request.outputs


def _check_output(path: Path, *, seed_only: bool) -> None:
    if path.is_block_device():
        raise ConfigError("is a device", where=str(path), hint=f"--device {path}")
    if seed_only and not path.exists():
        raise ConfigError(
            "no such file or folder", where=str(path), hint="without --seed-only it is made from an image"
        )
    if not seed_only and path.is_dir():
        raise ConfigError("is a folder", where=str(path), hint="name a file; a folder goes with --seed-only")
    if not path.parent.is_dir():
        raise ConfigError(f"there is no folder {path.parent}", where=str(path), hint="make it first")


def _ask_passphrase(ssid: str) -> str:
    if not sys.stdin.isatty():
        hint = f"put it into a --wifi-file, or into the environment as {wifi.PASSPHRASE}"
        raise ConfigError(f"no terminal to type the passphrase of '{ssid}'", where="--wifi", hint=hint)
    import getpass

    return getpass.getpass(f"Passphrase of Wi-Fi '{ssid}' (empty: open): ")


# ---------------------------------------------------------------- writing
def _flash(
    request: FlashRequest,
    robots: Sequence[RobotConfig],
    targets: Sequence[Card | Path],
    around: Surroundings,
    keys: Keys,
    shipment: Shipment,
    begin: Callable[[], None],
) -> list[CardResult]:
    assert request.image is not None  # noqa: S101  (`_targets` has seen to it)
    wanted = image.expected_sha256(request.image, request.sha256)
    if not request.image.is_file():
        with image.opened(request.image):
            pass  # raises what is wrong
    if wanted is None:
        output.progress("image: no SHA-256 given, so only its compression's own checks apply (--sha256)")
    digest = image.check_sha256(request.image, wanted, _progress("checksum"))
    with tempfile.TemporaryDirectory(prefix="fullswarm-flash-") as name:
        try:
            source = read_head(request.image, Path(name), _progress("reading the boot partition"))
            _check_sizes(targets, source.least_bytes)
            prepared = [prepare(robot, around, keys, shipment, source, request.first_boot) for robot in robots]
        except OSError as error:  # of this computer: an error of the image or the configuration is a ConfigError
            hint = "each card's boot partition is kept there for a while: `TMPDIR=/var/tmp fullswarm flash …`"
            raise ConfigError(f"cannot prepare the cards: {error.strerror}", where=name, hint=hint) from error
        lines = [
            CardResult(each.robot, _title(target), details={**each.details, "image_sha256": digest})
            for each, target in zip(prepared, targets, strict=True)
        ]
        if request.dry_run:
            return lines
        confirm_loss(targets, request.agreed, "everything on it will be lost")
        begin()
        with _partial(targets) as paths:
            jobs = [
                Job(each.robot, path, each.edited, each.volume.start_bytes)
                for each, path in zip(prepared, paths, strict=True)
            ]
            outcomes = _write(request.image, jobs)
            _keep(targets, paths, outcomes)
    for line, outcome in zip(lines, outcomes, strict=True):
        _note_outcome(line, outcome)
    return lines


def _check_sizes(targets: Sequence[Card | Path], needed: int) -> None:
    for each in targets:
        if isinstance(each, Card) and each.size_bytes < needed:
            hint = f"take one of {needed / 1e9:.0f} GB or more"
            raise ConfigError(f"the image needs {needed / 1e9:.1f} GB", where=each.title, hint=hint)


def _title(target: Card | Path) -> str:
    return target.title if isinstance(target, Card) else str(target)


@contextmanager
def _partial(targets: Sequence[Card | Path]) -> Iterator[list[Path]]:
    """Return where to write: cards themselves, files as `*.partial` until they are complete."""
    paths = [Path(each.path) if isinstance(each, Card) else each.with_name(f"{each.name}.partial") for each in targets]
    files = [path for path, each in zip(paths, targets, strict=True) if isinstance(each, Path)]
    for path in files:
        path.unlink(missing_ok=True)
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))  # it holds a private host key
    try:
        yield paths
    finally:
        for path in files:
            path.unlink(missing_ok=True)


def _keep(targets: Sequence[Card | Path], paths: Sequence[Path], outcomes: Sequence[Outcome]) -> None:
    for target, path, outcome in zip(targets, paths, outcomes, strict=True):
        if isinstance(target, Path) and outcome.error is None:
            path.replace(target)


def _write(picture: Path, jobs: Sequence[Job]) -> list[Outcome]:
    progress = _Progress()
    try:
        with image.opened(picture) as stream:
            return write_jobs(image.chunks(stream), jobs, progress)
    except (ConfigError, OSError) as error:  # of the image: an error of a card is in its outcome
        what = error.what if isinstance(error, ConfigError) else f"cannot be read: {error.strerror or error}"
        hint = f"{image.AGAIN}, then flash this card again"
        failed = CardFailed(f"half written, not usable: {picture} {what}", hint=hint)
        return [Outcome(each.name, error=failed) for each in jobs]
    except KeyboardInterrupt:
        output.progress(f"half written, not usable: {', '.join(str(each.target) for each in jobs)}; flash again")
        raise


def _note_outcome(line: CardResult, outcome: Outcome) -> None:
    if outcome.error is not None:
        line.state, line.note = "FAILED", str(outcome.error)
        return
    rate = outcome.bytes / 1e6 / max(outcome.write_s, 1e-3)
    line.state = "written"
    line.note = (
        f"{outcome.bytes / 1e9:.2f} GB in {outcome.write_s:.0f} s ({rate:.0f} MB/s), "
        f"read back in {outcome.verify_s:.0f} s: equal"
    )
    line.details |= {
        "bytes": outcome.bytes,
        "sha256": outcome.sha256,
        "write_s": round(outcome.write_s, 3),
        "verify_s": round(outcome.verify_s, 3),
    }


# ---------------------------------------------------------------- progress and result
class _Progress:
    """Prints how far cards are, every other second; called from the writers' threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._next: dict[tuple[str, str], float] = {}

    def __call__(self, name: str, what: str, done: int) -> None:
        now_s = time.monotonic()
        with self._lock:
            if now_s < self._next.setdefault((name, what), now_s + PROGRESS_S):
                return
            self._next[name, what] = now_s + PROGRESS_S
        output.progress(f"{name}: {what}: {done / 1e6:.0f} MB")


def _progress(what: str) -> image.Report:
    progress = _Progress()
    return lambda done: progress("image", what, done)


def _show(request: FlashRequest, lines: Sequence[CardResult], reported: dict[str, FirstReport]) -> int:
    failed = any(line.state.startswith("FAILED") for line in lines)
    if request.as_json:
        rows = [
            {
                "robot": line.robot,
                "target": line.target,
                "state": line.state,
                "note": line.note,
                **line.details,
                "hello": asdict(reported[line.robot]) if line.robot in reported else None,
            }
            for line in lines
        ]
        output.data_json({"ok": not failed, "dry_run": request.dry_run, "cards": rows})
    else:
        table = output.plain_table("robot", "card", "state", "what")
        for line in lines:
            note = line.note or f"{line.details['first_boot']}, release {line.details['release']}"
            table.add_row(*map(escape, (line.robot, line.target, line.state, note)))
        output.data_table(table, into_file=160)
        if not failed and not request.dry_run:
            output.progress("put the card in and switch the robot on; the first boot takes some minutes")
    return 1 if failed else 0


# ---------------------------------------------------------------- --seed-only: a partition that was written before
def _configure(
    request: FlashRequest,
    robots: Sequence[RobotConfig],
    targets: Sequence[Card | Path],
    around: Surroundings,
    keys: Keys,
    shipment: Shipment,
    begin: Callable[[], None],
) -> list[CardResult]:
    """Write the robots' files over those of their boot partitions, in place; `begin` is called before the first.

    Raises
    ------
    ConfigError
        A partition cannot be written; those before the named one may have been written then.
    """
    work = [_Place(robot, target) for robot, target in zip(robots, targets, strict=True)]
    built = [place.build(around, keys, shipment, request.first_boot) for place in work]
    if not request.dry_run:
        confirm_loss(targets, request.agreed)
        begin()
    lines = []
    for place, (files, instance, kind) in zip(work, built, strict=True):
        judged = "" if request.dry_run else place.put(files)
        state = "planned" if request.dry_run else "seeded"
        details = details_of(place.robot, around, keys, shipment, instance, kind, judged)
        lines.append(CardResult(place.robot.id, place.title, state, "" if request.dry_run else judged, details))
    return lines


class _Place:
    """Where a boot partition is: in a disk (`volume`), or mounted at a folder (None)."""

    def __init__(self, robot: RobotConfig, target: Card | Path) -> None:
        self.robot, self.title = robot, _title(target)
        self._path = Path(target.path) if isinstance(target, Card) else target
        self._volume = None if self._path.is_dir() else _volume_of(self._path)

    def build(
        self, around: Surroundings, keys: Keys, shipment: Shipment, wanted: str
    ) -> tuple[dict[str, bytes], str, str]:
        """Return the files, checked for room; the instance id; the kind of first boot."""
        path, volume = self._path, self._volume
        partition = BootPartition.of_folder(path) if volume is None else BootPartition.of_disk(path, volume)
        made = boot_files(self.robot, around, keys, shipment, partition, wanted)
        if volume is not None:
            old = sum(len(partition.read(name) or b"") for name in made[0])
            roomy = replace(volume, free_bytes=volume.free_bytes + old)  # what is overwritten makes room
            fat.check_room(roomy, made[0], str(path))
        return made

    def put(self, files: dict[str, bytes]) -> str:
        """Write; return how the partition was found afterwards."""
        if self._volume is not None:
            fat.put_files(self._path, self._volume, files)
            with self._path.open("rb") as disk:
                os.fsync(disk.fileno())
            return fat.fsck(self._path, self._volume)
        for name, content in files.items():
            target = self._path / name
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise explain(error, target, 0) from error
            if target.read_bytes() != content:
                raise ConfigError("reads back different from what was written", where=str(target), hint="another card")
        return f"{len(files)} files written; unmount it before you pull the card out"


def _volume_of(disk: Path) -> Volume:
    try:
        number = os.open(disk, os.O_RDWR | os.O_CLOEXEC | (os.O_EXCL if disk.is_block_device() else 0))
    except OSError as error:
        raise explain(error, disk, 0) from error
    try:
        return boot_volume(number, str(disk))
    finally:
        os.close(number)


# ---------------------------------------------------------------- host keys
def pin_host_key(robot: RobotConfig, swarm: str, keys: Keys) -> bool:
    """Pin a robot's own host key at its address; True when another one was pinned there before."""
    host = robot.host or f"{robot.id}.local"
    own = " ".join(public(keys.host_key(swarm, robot.id)).split()[:2])
    pins = Pins(keys.known_hosts, keys.host_key(swarm, robot.id).parent)
    name = known_hosts_name(host, robot.ssh_port)
    replaced = _forget_others(keys.known_hosts, name, own)
    pins.pin_flashed(robot.id, host, robot.ssh_port)
    return replaced


@contextmanager
def provisional_host_keys(robots: Sequence[RobotConfig], swarm: str, keys: Keys) -> Iterator[Callable[[], None]]:
    """Remove the host keys that are made within this context, unless the function it yields is called before writing.

    A pinned key that is on no card would make the robot at that address look like another computer.
    """
    fresh = [each.id for each in robots if not keys.has_host_key(swarm, each.id)]
    try:
        yield fresh.clear
    finally:
        for robot in fresh:
            keys.forget_host_key(swarm, robot)


def _forget_others(file: Path, name: str, own: str) -> bool:
    if not file.exists():
        return False
    lines = file.read_text("utf-8").splitlines()
    kept = [line for line in lines if not _is_other(line, name, own)]
    if kept == lines:
        return False
    replace_file(file, "".join(f"{line}\n" for line in kept), mode=0o600)
    return True


def _is_other(line: str, name: str, own: str) -> bool:
    words = line.split()
    if len(words) < 3 or line.startswith(("#", "@", "|")):
        return False
    return name in words[0].split(",") and f"{words[1]} {words[2]}" != own
