"""`fullswarm keys`: a base station's keys, and the certificates by which the processes of a swarm prove their names."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fullswarm import output
from fullswarm.cli.options import Json, Swarm, shell_command
from fullswarm.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from fullswarm.deploy.release.keys import Keys
    from fullswarm.identity.authority import Authority, Entry
    from fullswarm.identity.folder import KeysFolder

PASSPHRASE = "FULLSWARM_KEYS_PASSPHRASE"  # noqa: S105  (the name of a variable)
"""The passphrase of the authority's private key, for scripts."""

keys_app = typer.Typer(help="Make and list keys and certificates: what may log in, sign releases and join a swarm.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="A robot's id, an operator, or a process such as `core`.")]
Days = Annotated[
    float | None, typer.Option("--days", metavar="DAYS", help="Life of the certificates (default: 30, or as before).")
]


@keys_app.callback(invoke_without_command=True)
@shell_command()
def keys(context: typer.Context, as_json: Json = False) -> int:
    """Print this base's keys, and make those that are missing: one signs releases, one logs in to robots.

    Robots take releases signed by this key only: keep a backup of the folder, and keep it secret. The certificates of
    swarms are in the same folder: `fullswarm keys init FLEET.toml` makes them, `fullswarm keys list` shows them.
    """
    if context.invoked_subcommand is not None:
        if any(str(context.get_parameter_source(name)) == "ParameterSource.COMMANDLINE" for name in context.params):
            raise typer.BadParameter(f"options go behind '{context.invoked_subcommand}'")
        return 0
    from fullswarm.deploy.release.keys import Keys

    facts = _facts(Keys.default())
    if as_json:
        output.data_json(facts)
        return 0
    output.data(f"folder   {facts['folder']}")
    for name in ("release", "fleet"):
        output.data(f"{name:8} {facts[name]['fingerprint']}  {facts[name]['public']}")
    for each in facts["hosts"]:
        output.data(f"host     {each['fingerprint']}  {each['swarm']}/{each['robot']}")
    return 0


def _facts(ours: Keys) -> dict[str, Any]:
    from fullswarm.deploy.release.keys import fingerprint, public

    pairs = {"release": ours.release_key(), "fleet": ours.fleet_key()}
    hosts = sorted(ours.folder.glob("hosts/*/*_ed25519"))
    return {
        "folder": str(ours.folder),
        **{
            name: {"file": str(key), "fingerprint": fingerprint(key), "public": public(key)}
            for name, key in pairs.items()
        },
        "allowed_signers": ours.allowed_signers(),
        "hosts": [
            {"swarm": key.parent.name, "robot": key.name.removesuffix("_ed25519"), "fingerprint": fingerprint(key)}
            for key in hosts
        ],
    }


# ---------------------------------------------------------------- certificates
@keys_app.command()
@shell_command(needs="posix")
def init(
    fleet: Annotated[
        Path | None, typer.Argument(metavar="[FLEET.toml]", help="The fleet file: its swarm, robots and hub.")
    ] = None,
    swarm: Swarm = "swarm",
    days: Days = None,
    passphrase: Annotated[
        bool,
        typer.Option(
            "--passphrase",
            help=f"Encrypt the authority's private key (scripts: {PASSPHRASE}); nothing is renewed without it.",
        ),
    ] = False,
    as_json: Json = False,
) -> int:
    """Make a swarm's authority, and certificates for its robots, its processes and you as operator.

    Doing it again adds what is missing, such as a new robot of the fleet file.
    """
    from fullswarm.bringup.certificates import issue_all
    from fullswarm.bus.endpoint import is_secured
    from fullswarm.drivers.fleet_file import load_fleet
    from fullswarm.identity.authority import Authority
    from fullswarm.identity.folder import KeysFolder

    config = None if fleet is None else load_fleet(fleet)
    folder = KeysFolder.of(swarm if config is None else config.swarm)
    if folder.has_authority:
        authority = _open(folder)
    else:
        authority = Authority.make(folder, passphrase=_passphrase(new=True) if passphrase else None)
        output.progress(f"made the authority of swarm '{folder.swarm}': keep a backup of {folder.path}")
    issued = list(issue_all(authority, config, days))
    if as_json:
        new = {each.name for each in issued if each.state == "issued"}
        output.data_json([{**_row(each), "new": each.name in new} for each in _entries(folder)])
        return 0
    for each in issued:
        output.data(f"{each.name}: {each.state} ({each.role})")
        if each.state == "revoked":
            output.progress(
                f"{each.name} stays revoked; if it may come back: {folder.issue_command(each.name, each.role)}"
            )
    if config is not None and not is_secured(config.hub.endpoint):
        output.progress(f'the hub is not secured yet: [hub] endpoint = "tls/ADDRESS:7447" in {fleet}')
    return 0


@keys_app.command()
@shell_command(needs="posix")
def issue(
    name: Name,
    role: Annotated[
        str,
        typer.Option(
            "--role",
            metavar="ROLE",
            help="robot, core, centralised, hub, world, operator, console, observer or source (motion capture).",
        ),
    ],
    swarm: Swarm = "swarm",
    days: Days = None,
    address: Annotated[
        list[str] | None,
        typer.Option("--address", metavar="HOST", help="Where clients reach a hub; may be repeated."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Copy what its computer needs to this folder.")
    ] = None,
) -> int:
    """Issue a certificate, unless the name has a valid one; after `revoke`, with a new key."""
    from fullswarm.identity import ROLES
    from fullswarm.identity.authority import copy_to
    from fullswarm.identity.folder import IDENTITY, KeysFolder

    known = next((each for each in ROLES if each == role), None)
    if known is None:
        raise ConfigError(f"'{role}' is not a role", where="--role", hint=did_you_mean(role, ROLES))
    if address and known != "hub":
        raise ConfigError("only a hub has addresses", where="--address", hint="leave it out, or --role hub")
    folder = KeysFolder.of(swarm)
    _, new = _open(folder).issue(name, known, days=days, hosts=address or ())
    (entry,) = (each for each in _entries(folder) if each.name == name)
    output.progress(f"{name}: {'issued' if new else 'has a valid certificate; nothing was changed'}, {_until(entry)}")
    if out is None:
        output.data(str(folder.certificate_path(name)))
        return 0
    copied = copy_to(folder, name, out)
    output.progress(f"copy {out} to its computer, keep it secret, and set {IDENTITY} to it there")
    output.data(str(copied.certificate_path(name)))
    return 0


@keys_app.command()
@shell_command(needs="posix")
def renew(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Names (default: all valid).")] = None,
    swarm: Swarm = "swarm",
    days: Days = None,
) -> int:
    """Renew certificates now: same name and key, a new life. Running processes renew theirs automatically."""
    from fullswarm.identity.folder import KeysFolder

    folder = KeysFolder.of(swarm)
    authority = _open(folder)
    valid = {each.name for each in _entries(folder) if each.certificate is not None and not each.revoked}
    for name in names or sorted(valid):
        authority.renew(name, days=days)
    for entry in _entries(folder):
        if entry.name in (names or valid):
            output.data(f"{entry.name}: {_until(entry)}")
    return 0


@keys_app.command()
@shell_command(needs="posix")
def revoke(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Names whose certificates are revoked.")],
    swarm: Swarm = "swarm",
) -> int:
    """Revoke certificates: the hub drops their holders within a second. Needs no passphrase."""
    from fullswarm.identity import authority
    from fullswarm.identity.folder import KeysFolder

    folder = KeysFolder.of(swarm)
    for name in names:
        gone = authority.revoke(folder, name)
        output.data(f"{name}: {'revoked' if gone else 'was revoked already'}")
    return 0


@keys_app.command("list")
@shell_command()
def list_(swarm: Swarm = "swarm", as_json: Json = False) -> int:
    """List the certificates of a swarm: role, life, and what is wrong with them.

    Exit code 1 if one has expired or is damaged. Revoked ones are listed until their name gets another.
    """
    from fullswarm.identity.certificates import when
    from fullswarm.identity.folder import KeysFolder

    folder = KeysFolder.of(swarm)
    if not folder.names():
        hint = "`fullswarm keys init FLEET.toml` makes them; --swarm names another swarm"
        raise ConfigError(f"no certificates of swarm '{swarm}' are here", where=str(folder.path), hint=hint)
    entries = _entries(folder)
    code = 1 if any(each.problem and not each.revoked for each in entries) else 0
    if as_json:
        output.data_json([_row(each) for each in entries])
        return code
    table = output.plain_table("name", "role", "issued (UTC)", "expires (UTC)", "state")
    for each in entries:
        found = each.certificate
        times = ("-", "-") if found is None else (f"{when(found.issued_s):%F %R}", f"{when(found.expires_s):%F %R}")
        table.add_row(each.name, "-" if found is None else found.role, *times, _state(each))
    output.data_table(table)
    return code


def _entries(folder: KeysFolder) -> tuple[Entry, ...]:
    from fullswarm.clock import wall_time_s
    from fullswarm.identity.authority import list_certificates

    return list_certificates(folder, wall_time_s())


def _state(entry: Entry) -> str:
    from fullswarm.clock import wall_time_s

    if entry.problem:
        return entry.problem
    return "expires soon" if entry.certificate is not None and entry.certificate.ends_soon(wall_time_s()) else "valid"


def _until(entry: Entry) -> str:
    from fullswarm.identity.certificates import when

    if entry.certificate is None:
        return entry.problem
    return f"valid until {when(entry.certificate.expires_s):%F %R} UTC"


def _row(entry: Entry) -> dict[str, Any]:
    found = entry.certificate
    facts = {} if found is None else {
        "common_name": found.common_name, "role": found.role, "swarm": found.swarm, "issued_s": found.issued_s,
        "expires_s": found.expires_s, "hosts": list(found.hosts),
    }  # fmt: skip
    return {"name": entry.name, "state": _state(entry), "revoked": entry.revoked, **facts}


def _open(folder: KeysFolder) -> Authority:
    """Open the authority; ask for its passphrase if it has one."""
    from fullswarm.identity.authority import Authority

    path = folder.authority_key_path
    secret = path.exists() and b"ENCRYPTED" in path.read_bytes()[:64]
    return Authority.open(folder, passphrase=_passphrase(new=False) if secret else None)


def _passphrase(*, new: bool) -> str:
    given = os.environ.get(PASSPHRASE)
    if not given and sys.stdin.isatty():
        given = str(typer.prompt("passphrase of the authority", hide_input=True, confirmation_prompt=new, err=True))
    if not given:
        raise ConfigError(
            "the authority's private key needs a passphrase", hint=f"run it in a terminal, or {PASSPHRASE}"
        )
    return given
