"""`fullswarm flash`: decide and check everything, ask, write, read back, remember, wait."""

from __future__ import annotations

import errno
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from fullswarm import output
from fullswarm.config import RobotConfig
from fullswarm.deploy.flash import card, image, mtools, pins, plan, seed_only, wait, wifi
from fullswarm.deploy.flash.card import Card
from fullswarm.deploy.flash.order import Line, Request, agree
from fullswarm.deploy.flash.payload import Shipment, Surroundings
from fullswarm.deploy.flash.write import CardFailed, Job, Outcome, explain, write_jobs
from fullswarm.deploy.fleet.choose import needs
from fullswarm.deploy.release.keys import Keys, usable
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.operator import session

TELL_S = 2.0


def run(request: Request) -> int:
    """Do it; return 0, 1 when a card failed.

    Raises
    ------
    ConfigError
        Anything is wrong; nothing has been written then.
    Unreachable
        All cards are written, but a robot was not heard within the time to wait.
    """
    keys = Keys.default()
    try:
        with usable(keys.folder):
            return _run(request, keys)
    finally:
        _hand_over(keys.folder)


def _run(request: Request, keys: Keys) -> int:
    config = load_fleet(request.fleet)
    robots = plan.robots_of(config, request.robots)
    targets = _targets(request, robots)
    mtools.check_there()
    networks, country = wifi.gather(request.wifi_file, request.wifi, request.country, _ask_passphrase)
    around = Surroundings(config, networks, country, request.static)
    extras = frozenset().union(*(needs(each, config) for each in robots))
    shipment = plan.release_for(request.release, request.target, request.image, keys, extras)
    output.progress(f"release {shipment.id}: signature good, {len(shipment.body) / 1e6:.1f} MB on the card")
    hub = session.Target(request.hub or config.hub.endpoint, config.swarm)
    if request.wait_minutes is not None and not request.dry_run:
        wait.check(hub)  # before a byte is written
    with pins.on_trial(robots, config.swarm, keys) as begin:
        work = seed_only.run if request.seed_only else _flash
        lines = work(request, robots, targets, around, keys, shipment, begin)
    if request.dry_run:
        return _show(request, lines, {})
    good = [line.robot for line in lines if not line.state.startswith("FAILED")]
    for robot in robots:
        if robot.id in good and pins.pin(robot, config.swarm, keys):
            output.progress(f"{robot.id}: another host key was known at its address; it is forgotten")
    if request.wait_minutes is None or not good:
        return _show(request, lines, {})
    return _wait(request, lines, hub, good, request.wait_minutes)


def _wait(request: Request, lines: Sequence[Line], hub: session.Target, robots: Sequence[str], minutes: float) -> int:
    """Show what was written whatever comes of the waiting: at once to a person, at the end as the one document."""
    code = 0 if request.as_json else _show(request, lines, {})
    heard: dict[str, wait.Hello] = {}
    try:
        heard, silent = wait.wait(hub, robots, minutes)
    finally:
        if request.as_json:
            code = _show(request, lines, heard)
    if silent:
        what = f"nothing was heard within {minutes:g} minutes"
        raise Unreachable(what, where=", ".join(silent), hint=wait.ADVICE)
    return code


def _hand_over(folder: Path) -> None:
    """Give what root has made among a user's keys to that user, whose next command runs without sudo."""
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


def _targets(request: Request, robots: Sequence[RobotConfig]) -> tuple[Card | Path, ...]:
    if bool(request.devices) == bool(request.outputs):
        hint = "--device /dev/sdX for a card, or --output FILE for an image"
        raise ConfigError("name either devices or files to write", where="flash", hint=hint)
    count = len(request.devices or request.outputs)
    if count != len(robots):
        hint = "one --device or --output per robot, in the same order"
        raise ConfigError(f"{len(robots)} robots, but {count} cards", where="flash", hint=hint)
    if request.image is None and not request.seed_only:
        hint = "--image raspios.img.xz, or --seed-only for a card that was written before"
        raise ConfigError("which image?", where="--image", hint=hint)
    if request.devices:
        cards = card.choose(card.list_cards(), request.devices, request.most_bytes)
        for each in cards:  # known before the image is read and the serial number typed
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
    request: Request,
    robots: Sequence[RobotConfig],
    targets: Sequence[Card | Path],
    around: Surroundings,
    keys: Keys,
    shipment: Shipment,
    begin: Callable[[], None],
) -> list[Line]:
    assert request.image is not None  # noqa: S101  (`_targets` has seen to it)
    wanted = image.expected_sha256(request.image, request.sha256)
    if not request.image.is_file():
        with image.opened(request.image):
            pass  # says what is wrong
    if wanted is None:
        output.progress("image: no SHA-256 given, so only its compression's own checks apply (--sha256)")
    digest = image.check_sha256(request.image, wanted, _teller("checksum"))
    with tempfile.TemporaryDirectory(prefix="fullswarm-flash-") as name:
        try:
            source = plan.read_head(request.image, Path(name), _teller("reading the boot partition"))
            _check_sizes(targets, source.least_bytes)
            prepared = [plan.prepare(robot, around, keys, shipment, source, request.first_boot) for robot in robots]
        except OSError as error:  # of this computer: what is wrong with image or seed is a ConfigError
            hint = "each card's boot partition lies there for a while: `TMPDIR=/var/tmp fullswarm flash …`"
            raise ConfigError(f"cannot prepare the cards: {error.strerror}", where=name, hint=hint) from error
        lines = [
            Line(
                each.robot,
                _title(target),
                details={
                    "instance": each.instance,
                    "host_key": each.host_key,
                    "first_boot": each.kind,
                    "boot_partition": each.judged,
                    "release": shipment.id,
                    "image_sha256": digest,
                    "wifi": [network.ssid for network in around.networks],
                },
            )
            for each, target in zip(prepared, targets, strict=True)
        ]
        if request.dry_run:
            return lines
        agree(targets, request.agreed, "everything on it will be lost")
        begin()
        with _partial(targets) as paths:
            jobs = [
                Job(each.robot, path, each.edited, each.volume.start_bytes)
                for each, path in zip(prepared, paths, strict=True)
            ]
            outcomes = _write(request.image, jobs)
            _keep(targets, paths, outcomes)
    for line, outcome in zip(lines, outcomes, strict=True):
        _tell_outcome(line, outcome)
    return lines


def _check_sizes(targets: Sequence[Card | Path], needed: int) -> None:
    for each in targets:
        free = each.size_bytes if isinstance(each, Card) else shutil.disk_usage(each.parent).free
        what = _title(each)
        if isinstance(each, Card) and free < needed:
            hint = f"take one of {needed / 1e9:.0f} GB or more"
            raise ConfigError(f"the image needs {needed / 1e9:.1f} GB", where=what, hint=hint)


def _title(target: Card | Path) -> str:
    return target.title if isinstance(target, Card) else str(target)


@contextmanager
def _partial(targets: Sequence[Card | Path]) -> Iterator[list[Path]]:
    """Name what is written: cards themselves, files under a name that says they are not whole yet."""
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
    teller = _Teller()
    try:
        with image.opened(picture) as stream:
            return write_jobs(image.chunks(stream), jobs, teller)
    except (ConfigError, OSError) as error:  # of the image: what goes wrong with a card stands in its outcome
        what = error.what if isinstance(error, ConfigError) else f"cannot be read: {error.strerror or error}"
        hint = f"{image.AGAIN}, then flash this card again"
        failed = CardFailed(f"half written, not usable: {picture} {what}", hint=hint)
        return [Outcome(each.name, error=failed) for each in jobs]
    except KeyboardInterrupt:
        output.progress(f"half written, not usable: {', '.join(str(each.target) for each in jobs)}; flash again")
        raise


def _tell_outcome(line: Line, outcome: Outcome) -> None:
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


# ---------------------------------------------------------------- telling
class _Teller:
    """Tells how far cards are, every other second; called from the writers' threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._next: dict[tuple[str, str], float] = {}

    def __call__(self, name: str, what: str, done: int) -> None:
        now_s = time.monotonic()
        with self._lock:
            if now_s < self._next.setdefault((name, what), now_s + TELL_S):
                return
            self._next[name, what] = now_s + TELL_S
        output.progress(f"{name}: {what}: {done / 1e6:.0f} MB")


def _teller(what: str) -> image.Tell:
    teller = _Teller()
    return lambda done: teller("image", what, done)


def _show(request: Request, lines: Sequence[Line], heard: dict[str, wait.Hello]) -> int:
    failed = any(line.state.startswith("FAILED") for line in lines)
    if request.as_json:
        rows = [
            {
                "robot": line.robot,
                "target": line.target,
                "state": line.state,
                "note": line.note,
                **line.details,
                "hello": asdict(heard[line.robot]) if line.robot in heard else None,
            }
            for line in lines
        ]
        output.data_json({"ok": not failed, "dry_run": request.dry_run, "cards": rows})
    else:
        table = Table(box=None, pad_edge=False)
        for column in ("robot", "card", "state", "what"):
            table.add_column(column, overflow="fold")
        for line in lines:
            note = line.note or f"{line.details['first_boot']}, release {line.details['release']}"
            table.add_row(line.robot, line.target, line.state, note)
        output.data_table(table, into_file=160)
        if not failed and not request.dry_run:
            output.progress("put the card in and switch the robot on; the first boot takes some minutes")
    return 1 if failed else 0
