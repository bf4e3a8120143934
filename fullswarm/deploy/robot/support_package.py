"""Packs the robot support package: what is on a robot outside every release, as one tar that ``install.sh`` installs.

::

    kit.statement         number, expiry, and digests of install.sh and kit.sums by robot, with their signature
    install.sh            run as root in the folder that the tar was unpacked to; safe to run again
    root                  root metadata: the keys that the robot trusts after its first installation
    kit.sums              `sha256sum` lines of what follows, by destination: what is installed, and whether it is whole
    files/<destination>   opt/fullswarm/bin, etc/systemd/system, etc/udev/rules.d, etc/fullswarm …

The same input gives the same bytes, so that a robot that has a package already need not get it again: `package_id` of
the tar is what ``fullswarm-robot facts`` calls ``kit`` while all its files are there unchanged. Only the statement
differs each time; `signed` adds it, by one signature for all robots. A first installation, over SSH or from a card,
does not need it, because the robot trusts no key yet.
"""

from __future__ import annotations

import hashlib
import io
import re
import tarfile
import time
from collections.abc import Mapping
from pathlib import Path

import tomlkit

from fullswarm.bus.endpoint import host_of, is_loopback, is_secured
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.signatures import SUPPORT_NAMESPACE, sign, split
from fullswarm.deploy.release.trust import SUPPORT_LIFE_S, support_text
from fullswarm.errors import ConfigError
from fullswarm.identity import Credentials
from fullswarm.identity.folder import AUTHORITY, CERTIFICATE, IDENTITY, ISSUED, KEY, KeysFolder

TOOLS = Path(__file__).parent
DESTINATIONS = {
    "fullswarm-robot": "opt/fullswarm/bin/fullswarm-robot",
    "robot-trust.sh": "opt/fullswarm/bin/robot-trust.sh",
    "robot-shipping.sh": "opt/fullswarm/bin/robot-shipping.sh",
    "robot-facts.sh": "opt/fullswarm/bin/robot-facts.sh",
    "fullswarm-agent.service": "etc/systemd/system/fullswarm-agent.service",
    "fullswarm-boot.service": "etc/systemd/system/fullswarm-boot.service",
    "60-fullswarm-ports.rules": "etc/udev/rules.d/60-fullswarm-ports.rules",
    "60-fullswarm-journal.conf": "etc/systemd/journald.conf.d/60-fullswarm-journal.conf",
    "60-fullswarm-sshd.conf": "etc/ssh/sshd_config.d/60-fullswarm.conf",
}
"""Destination of each file of this folder, from the root."""
PROGRAMS = frozenset({"install.sh", "opt/fullswarm/bin/fullswarm-robot"})
TRUST_FIRST = "opt/fullswarm/bin/robot-trust.sh"
SUDOERS = "etc/sudoers.d/fullswarm"
ISSUED_TO = "etc/fullswarm/identity"
"""The robot's certificate, its key and the authority's certificate: mode 0600, of the agent's user."""
RENEWED_TO = "/var/lib/fullswarm/identity"
"""Where the agent keeps them while it runs, and renews the certificate."""
RULE = "ALL=(root) NOPASSWD: /opt/fullswarm/bin/fullswarm-robot"
"""What the SSH user may do as root."""

_USER = re.compile(r"[a-z_][a-z0-9_-]{0,31}\Z")
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


def support_package(
    robot: RobotConfig,
    config: SwarmConfig,
    root: str,
    *,
    ssh_user: str | None = None,
    environment: Mapping[str, str] | None = None,
    credentials: Credentials | None = None,
    tools: Path = TOOLS,
) -> bytes:
    """Return the support package of one robot: an uncompressed tar, some 50 kB.

    Parameters
    ----------
    root
        Root metadata: the keys that the robot trusts after its first installation.
    ssh_user
        The user who may run ``fullswarm-robot`` as root without a password; None: the fleet file's. ``root`` needs no
        rule.
    environment
        Further lines of ``robot.env``, which the agent gets as its environment.
    credentials
        The robot's files for a secured hub; see :func:`robot_credentials`.
    tools
        Folder of the files to install, for example ``robot/`` of another release.

    Raises
    ------
    ConfigError
        A user or an environment variable is invalid.
    """
    files = {destination: (tools / name).read_bytes() for name, destination in DESTINATIONS.items()}
    environment = dict(environment or {})
    if credentials is not None:
        environment |= {IDENTITY: RENEWED_TO, ISSUED: f"/{ISSUED_TO}"}
        sources = {AUTHORITY: credentials.authority, CERTIFICATE: credentials.certificate, KEY: credentials.key}
        files |= {f"{ISSUED_TO}/{name}": path.read_bytes() for name, path in sources.items()}
    files["etc/fullswarm/robot.env"] = robot_env(robot, config, environment).encode()
    files["etc/fullswarm/fleet.toml"] = fleet_file(config).encode()
    user = robot.ssh_user if ssh_user is None else ssh_user
    if user != "root":
        files[SUDOERS] = _sudoers(user).encode()
    # The files that it sources come before the program: one that is killed half-way leaves a program that starts.
    ordered = sorted(files, key=lambda path: (path in PROGRAMS, path != TRUST_FIRST, path))
    sums = "".join(f"{hashlib.sha256(files[path]).hexdigest()}  {path}\n" for path in ordered)
    members = {f"files/{path}": files[path] for path in sorted(files)}
    installer = (tools / "install.sh").read_bytes()
    return _tar({"install.sh": installer, "root": split(root)[0].encode(), "kit.sums": sums.encode(), **members})


def signed(packages: Mapping[str, bytes], keys: Keys, *, rename: bool = False) -> dict[str, bytes]:
    """Return support packages, by robot, with the statement by which robots that trust our keys accept them.

    Parameters
    ----------
    rename
        Robots that have another name accept theirs, too.

    Raises
    ------
    ConfigError
        The release key cannot sign, or robots do not trust it.
    """
    key, number = keys.signing_key(), keys.next_number()
    parts = {robot: (_digest(each, "install.sh"), _digest(each, "kit.sums")) for robot, each in packages.items()}
    text = support_text(number, max(number, int(time.time())) + SUPPORT_LIFE_S, parts, rename=rename)
    document = (text + sign(text.encode(), SUPPORT_NAMESPACE, key)).encode()
    return {robot: _member("kit.statement", document) + archive for robot, archive in packages.items()}


def _digest(archive: bytes, name: str) -> str:
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        member = tar.extractfile(name)
        assert member is not None  # noqa: S101  (`support_package` adds it)
        return hashlib.sha256(member.read()).hexdigest()


def check_hub(robot: RobotConfig, config: SwarmConfig) -> None:
    """Refuse an endpoint of the hub at which a robot would reach itself.

    Raises
    ------
    ConfigError
        The hub's address is this machine's own loopback, and the robot is another machine.
    """
    if is_loopback(host_of(config.hub.endpoint)) and not is_loopback(robot.host or robot.id):
        hint = (
            'write the base\'s own address, [hub] endpoint = "tls/10.0.0.1:7447", and make its keys there: '
            "`fullswarm keys init FLEET.toml`"
        )
        raise ConfigError(f"{robot.id} cannot reach {config.hub.endpoint}", where="hub.endpoint", hint=hint)


def robot_credentials(robot: RobotConfig, config: SwarmConfig, now_s: float) -> Credentials | None:
    """Return a robot's files in the keys folder of this base, checked; None: the hub is not secured.

    Parameters
    ----------
    now_s
        Seconds since 1970.

    Raises
    ------
    ConfigError
        It has no certificate, or one that is revoked, expired or damaged; the hint is the command that mends it.
    """
    if not is_secured(config.hub.endpoint):
        return None
    folder = KeysFolder.of(config.swarm)
    found = folder.credentials(robot.id, "robot")
    from fullswarm.identity.certificates import read_certificate

    certificate = read_certificate(found.certificate)
    if certificate.common_name not in {each.common_name for each in folder.grants()}:
        hint = folder.issue_command(robot.id, "robot")
        raise ConfigError(f"the certificate of '{robot.id}' is revoked", where=str(found.certificate), hint=hint)
    if certificate.expires_s <= now_s:
        hint = f"fullswarm keys renew {robot.id} --swarm {config.swarm}"
        raise ConfigError(f"the certificate of '{robot.id}' has expired", where=str(found.certificate), hint=hint)
    return found


def package_id(archive: bytes) -> str:
    """Return the id of a support package: what ``fullswarm-robot facts`` reports while it is installed unchanged."""
    return _digest(archive, "kit.sums")[:12]


def fleet_file(config: SwarmConfig) -> str:
    """Return the fleet as a robot needs it: only what differs from the defaults.

    An older release that the robot rolls back to must be able to read it, so no key is written that is not needed.
    """
    values = config.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    for each in values.get("robot", ()):
        for key in ("host", "ssh_user", "ssh_port"):
            each.pop(key, None)
    values.pop("core", None)  # files of the base
    return tomlkit.dumps(values)


def robot_env(robot: RobotConfig, config: SwarmConfig, environment: Mapping[str, str]) -> str:
    """Return ``robot.env``, which both systemd and a shell read: ``NAME="value"`` lines."""
    values = {"ROBOT": robot.id, "FULLSWARM_SWARM": config.swarm, **environment}
    for name, value in values.items():
        if not _VARIABLE.match(name) or re.search(r'["\\$`\n\0]', value):
            raise ConfigError(
                f"'{name}={value}' is not allowed in a robot's environment",
                hint="no quotes, $, backslashes or newlines",
            )
    return "".join(f'{name}="{value}"\n' for name, value in sorted(values.items()))


def _sudoers(user: str) -> str:
    if not _USER.match(user):
        raise ConfigError(f"'{user}' is not a valid user", where="ssh_user", hint="a plain Linux login: a-z, 0-9, - _")
    return f"{user} {RULE}\n"


def _mode(name: str) -> int:
    if name.startswith(f"{ISSUED_TO}/"):
        return 0o600
    return 0o755 if name in PROGRAMS else 0o644


def _tar(members: Mapping[str, bytes]) -> bytes:
    """Pack without times and owners: the same members give the same bytes."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, content in members.items():
            tar.addfile(_entry(name, content), io.BytesIO(content))
    return buffer.getvalue()


def _entry(name: str, content: bytes) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    entry.mode = _mode(name.removeprefix("files/"))
    return entry


def _member(name: str, content: bytes) -> bytes:
    """Return one member of a tar, to be put before an archive."""
    return _entry(name, content).tobuf(tarfile.USTAR_FORMAT) + content + bytes(-len(content) % tarfile.BLOCKSIZE)
