"""`fullswarm flash`: writes SD cards for unattended first boot."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Json, shell_command


class FirstBoot(StrEnum):
    """How an image is configured at first boot."""

    AUTO = "auto"
    CLOUD_INIT = "cloud-init"
    FIRSTRUN = "firstrun"


@shell_command(needs="linux")
def flash(
    robots: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ROBOT]...", help="Ids in the fleet file, one per card.", autocompletion=completion.fleet_robots
        ),
    ] = None,
    fleet: Annotated[
        Path | None, typer.Option("--fleet", envvar="FULLSWARM_FLEET", metavar="FILE", help="The fleet file (TOML).")
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Image of Raspberry Pi OS or similar: .img, .img.xz, .img.gz, .img.zst"),
    ] = None,
    device: Annotated[
        list[str] | None, typer.Option(metavar="/dev/sdX", help="The card to write; repeat for several robots.")
    ] = None,
    to_file: Annotated[
        list[Path] | None, typer.Option("--output", metavar="FILE", help="Write an image file instead of a card.")
    ] = None,
    seed_only: Annotated[
        bool,
        typer.Option(
            "--seed-only", help="Write only the first-boot configuration (card, image file, mounted boot folder)."
        ),
    ] = False,
    release: Annotated[
        str | None, typer.Option(metavar="ID|DIR", help="The release of the robot (default: the newest for --target).")
    ] = None,
    target: Annotated[
        str, typer.Option(metavar="NAME", help="The target of the release: rpi-arm64, x86_64.")
    ] = "rpi-arm64",
    wifi: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SSID", help="Wi-Fi network; prompts for its passphrase unless FULLSWARM_WIFI_PASSPHRASE is set."
        ),
    ] = None,
    wifi_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Networks and country as TOML; readable by its owner only.")
    ] = None,
    country: Annotated[
        str | None, typer.Option(metavar="XX", help="Country of use, e.g. DE; required for Wi-Fi.")
    ] = None,
    static: Annotated[
        str | None,
        typer.Option(metavar="ROUTER/PREFIX", help="Use static addresses: each robot's `host`, router 10.0.0.1/24."),
    ] = None,
    sha256: Annotated[
        str | None, typer.Option(metavar="HEX", help="Hash of the image file (default: from FILE.sha256 beside it).")
    ] = None,
    first_boot: Annotated[
        FirstBoot, typer.Option(help="How the image is configured; auto: by its boot partition.")
    ] = FirstBoot.AUTO,
    yes: Annotated[
        list[str] | None,
        typer.Option(metavar="SERIAL", help="Overwrite the card with this serial number without a prompt."),
    ] = None,
    max_size: Annotated[int, typer.Option(min=1, metavar="GB", help="Refuse larger devices.")] = 300,
    full_sudo: Annotated[
        bool,
        typer.Option(
            "--full-sudo", help="Let the SSH user become root (default: it may run `fullswarm-robot` as root)."
        ),
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until the robots report on the fleet's hub.")] = False,
    minutes: Annotated[float, typer.Option(min=0.01, max=1440, help="Time limit of --wait.")] = 15.0,
    hub: Annotated[
        str | None,
        typer.Option(
            envvar="FULLSWARM_HUB", metavar="ENDPOINT", help="The hub for --wait (default: the fleet file's)."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(readable=False, metavar="CARD|FILE|DIR", help="Print the report of a first boot from a card."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything, write no card.")] = False,
    as_json: Json = False,
) -> int:
    """Flash SD cards for unattended first boot: Wi-Fi and software, offline. Print their reports.

    Exit code 0: written and read back; 1: a card failed; 2: refused; 3: --wait received nothing.
    """
    from fullswarm.deploy.flash.plan import FlashRequest
    from fullswarm.deploy.flash.result import print_report
    from fullswarm.deploy.flash.run import run
    from fullswarm.errors import ConfigError

    if report is not None:
        return print_report(report, as_json=as_json)
    if not robots or fleet is None:
        missing = "robots" if not robots else "--fleet"
        hint = "fullswarm flash r1 --fleet lab.toml --image raspios.img.xz --device /dev/sdX"
        raise ConfigError(f"{missing} missing", where="flash", hint=hint)
    return run(
        FlashRequest(
            robots=tuple(robots),
            fleet=fleet,
            image=image,
            devices=tuple(device or ()),
            outputs=tuple(to_file or ()),
            seed_only=seed_only,
            release=release,
            target=target,
            wifi=tuple(wifi or ()),
            wifi_file=wifi_file,
            country=country,
            static=static,
            sha256=sha256,
            first_boot=first_boot.value,
            agreed=tuple(yes or ()),
            most_bytes=max_size * 1_000_000_000,
            wait_minutes=minutes if wait else None,
            hub=hub,
            full_sudo=full_sudo,
            dry_run=dry_run,
            as_json=as_json,
        )
    )
