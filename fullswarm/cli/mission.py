"""`fullswarm request FILE.toml` and `fullswarm mission`: starts, shows and controls missions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, Take, Timeout, shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget, Target
    from fullswarm.messages import MissionOp, MissionReply, MissionStatus
    from fullswarm.operator.missions import MissionClient
    from fullswarm.operator.session import Session

ANSWER_S = 5.0

mission_app = typer.Typer(help="Show and control missions. `fullswarm request FILE.toml` starts one.")
Mission = Annotated[str, typer.Argument(metavar="[MISSION]", help="Its name or id (default: the only one there is).")]


def is_mission(name: str) -> bool:
    """Tell whether the argument of `request` is a mission file."""
    return name.endswith(".toml")


def check_options(name: str, *, given: bool) -> None:
    """Refuse options of `request` that do not go together; `given`: robots or parameters were."""
    if not is_mission(name):
        raise ConfigError("--check is for mission files", where=name, hint="e.g. survey.toml")
    if given:
        raise ConfigError("the file names its robots and parameters", where=name, hint="edit the file")


# ---------------------------------------------------------------- start
def start(target: Target, file: Path, *, check: bool, wait: bool, take: bool, timeout: float, as_json: bool) -> int:
    """Start the mission of a file, or only check it; with `wait` follow it until it has ended.

    Raises
    ------
    ConfigError
        All that is wrong with the file or does not fit the swarm, each with its line.
    """
    from fullswarm.config.mission_file import load_mission
    from fullswarm.operator import session
    from fullswarm.operator.missions import plain, refusal

    read = load_mission(file)
    with session.connect(target) as connection:
        follower = _Follower(connection)
        reply = follower.ask(
            lambda client, done: client.ask("check" if check else "start", done, plan=read.plan, take=take), timeout
        )
        if not reply.ok:
            raise refusal(reply, read)
        if check:
            output.progress(f"{file}: mission '{read.plan.name}' fits this swarm; nothing was started")
            return 0
        follower.wait_for(reply.mission, ended=wait)
        status = follower.client.missions.get(reply.mission)
        follower.close()
    if as_json and status is not None:
        output.data_json(plain(status))
    elif status is not None:
        output.data("\n".join(lines_of(status)))
    if status is None:
        raise connection.no_core(timeout)
    if not wait and not as_json:
        output.progress(f"started; `fullswarm mission show {status.name}` shows it, `fullswarm stop` pauses it")
    return 1 if status.phase in ("failed", "aborted") else 0


class _Follower:
    """Asks the core, and prints what changes of one mission."""

    def __init__(self, connection: Session) -> None:
        from fullswarm.clock import clock_id
        from fullswarm.operator.missions import MissionClient

        self._connection, self._mission, self._ended = connection, "", False
        self._shown: dict[str, str] = {}
        self.client: MissionClient = MissionClient(
            connection.bus,
            connection.keys,
            connection.runtime,
            connection.source,
            name=connection.operator.name,
            clock=clock_id(),
            on_status=self._received,
        )

    def ask(
        self, send: Callable[[MissionClient, Callable[[MissionReply], None]], object], timeout: float
    ) -> MissionReply:
        """Send a request and return the answer; raises `Unreachable` when there is none."""
        found: list[MissionReply] = []

        def receive(reply: MissionReply) -> None:
            found.append(reply)
            self._connection.runtime.pause()

        send(self.client, receive)
        self._connection.run(timeout)
        if not found:
            raise self._connection.no_core(timeout)
        return found[0]

    def wait_for(self, mission: str, *, ended: bool) -> None:
        """Wait for a mission's state, and with `ended` for its end; Ctrl-C leaves it running."""
        self._mission, self._ended = mission, ended
        if mission in self.client.missions:
            self._received(self.client.missions[mission])
            if not ended:
                return
        self._connection.run(None if ended else ANSWER_S)

    def close(self) -> None:
        """End it."""
        self.client.close()

    def _received(self, status: MissionStatus) -> None:
        from fullswarm.operator.missions import ENDED

        if status.mission != self._mission:
            return
        if self._ended:
            for line in changes(self._shown, status):
                output.progress(line)
        if not self._ended or status.phase in ENDED:
            self._connection.runtime.pause()


def changes(shown: dict[str, str], status: MissionStatus) -> list[str]:
    """Return lines for what is new in `status`, and note them in `shown`."""
    found = []
    for track in status.tracks:
        for step in track.steps:
            path = f"{track.name}/{step.name}"
            text = f"{step.phase}{f': {step.reason}' if step.reason else ''}"
            if step.confirm:
                text += f': {step.confirm} Confirm: fullswarm mission confirm {status.name} --step "{path}"'
            if shown.get(path, "waiting") != text:
                found.append(f"{path}: {text}")
            shown[path] = text
    text = f"mission {status.name}: {status.phase}{f': {status.reason}' if status.reason else ''}"
    if shown.get("") != text:
        found.append(text)
    shown[""] = text
    return found


def lines_of(status: MissionStatus) -> list[str]:
    """Return a mission as text: one line, then one per step."""
    reason = f": {status.reason}" if status.reason else ""
    lines = [f"{status.name} ({status.mission}), started by {status.operator}: {status.phase}{reason}"]
    for track in status.tracks:
        lines.append(f"  {track.name}")
        for step in track.steps:
            robots = ", ".join(step.robots) or "all robots"
            what = f"{step.behaviour} for {robots}" if step.behaviour else "no behaviour"
            elapsed = f", {step.elapsed_s:.0f} s" if step.phase != "waiting" else ""
            lines.append(f"    {step.phase:8} {step.name}: {what}{elapsed}")
            lines += [f"             {text}" for text in (*step.waits_for, *([step.reason] if step.reason else ()))]
    return lines


# ---------------------------------------------------------------- show, pause, resume, abort, confirm
@mission_app.command("show")
@shell_command()
def show(target: Target, mission: Mission = "", as_json: Json = False) -> int:
    """Show the missions of this swarm: their steps, and what each waits for."""
    from fullswarm.operator import session
    from fullswarm.operator.missions import plain

    with session.connect(target) as connection:
        follower = _Follower(connection)
        follower.ask(lambda client, done: client.ask("show", done), ANSWER_S)
        found = [each for each in follower.client.missions.values() if mission in ("", each.name, each.mission)]
        follower.close()
    if mission and not found:
        raise ConfigError(f"no mission '{mission}'", hint="`fullswarm mission show` lists them")
    if as_json:
        output.data_json([plain(each) for each in found])
    elif found:
        output.data("\n".join(line for each in found for line in lines_of(each)))
    else:
        output.progress("there is no mission; `fullswarm request FILE.toml` starts one")
    return 0


def _control(target: Target, op: MissionOp, done: str, mission: str, timeout: float, step: str, take: bool) -> int:
    from fullswarm.operator import session
    from fullswarm.operator.missions import refusal

    track, _, name = step.rpartition("/")
    with session.connect(target) as connection:
        follower = _Follower(connection)
        reply = follower.ask(
            lambda client, receive: client.ask(op, receive, mission=mission, track=track, step=name, take=take), timeout
        )
        if not reply.ok:
            raise refusal(reply)
        follower.wait_for(reply.mission, ended=False)
        status = follower.client.missions.get(reply.mission)
        follower.close()
    output.progress(f"{done} {status.name if status else reply.mission}")
    return 0


@mission_app.command("pause")
@shell_command()
def pause(target: NamedTarget, mission: Mission = "", timeout: Timeout = ANSWER_S) -> int:
    """Pause a mission: its robots stop. `resume` requests the steps that ran again."""
    return _control(target, "pause", "paused", mission, timeout, "", False)


@mission_app.command("resume")
@shell_command()
def resume(target: NamedTarget, mission: Mission = "", take: Take = False, timeout: Timeout = ANSWER_S) -> int:
    """Resume a paused mission with the steps that it was in."""
    return _control(target, "resume", "resumed", mission, timeout, "", take)


@mission_app.command("abort")
@shell_command()
def abort(target: NamedTarget, mission: Mission = "", timeout: Timeout = ANSWER_S) -> int:
    """Abort a mission for good: its robots stop."""
    return _control(target, "abort", "aborted", mission, timeout, "", False)


@mission_app.command("confirm")
@shell_command()
def confirm(
    target: NamedTarget,
    mission: Mission = "",
    step: Annotated[str, typer.Option(metavar="TRACK/STEP", help="The step (default: the only one that waits).")] = "",
    timeout: Timeout = ANSWER_S,
) -> int:
    """Confirm the step that waits for an operator."""
    return _control(target, "confirm", "confirmed a step of", mission, timeout, step, False)
