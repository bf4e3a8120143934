"""The commands that move robots, or end their motion: `request`, `mock`, `drive` and `stop`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli import completion
from fullswarm.cli.mission import check_options, is_mission, start
from fullswarm.cli.options import Json, RobotArguments, Robots, Take, Timeout, robot_ids, shell_command
from fullswarm.cli.values import parse_needs, parse_parameters, parse_roles
from fullswarm.errors import Unreachable

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget, Target
    from fullswarm.messages import EStop, RequestStatus, StopRequest

ANSWER_S = 2.0
"""For the robots to answer a request that the core accepted; they do within 0.1 s unless messages are lost."""

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Set a parameter: 1.5, true, 5,5 (a point), [[0, 0], [1, 1]], or a word.",
        autocompletion=completion.parameters,
    ),
]
Behaviour = Annotated[
    str, typer.Argument(help="Its name; `fullswarm behaviours` lists them.", autocompletion=completion.behaviours)
]
Requested = Annotated[
    str,
    typer.Argument(
        metavar="BEHAVIOUR|FILE.toml",
        help="A behaviour (`fullswarm behaviours` lists them), or a mission file.",
        autocompletion=completion.behaviours,
    ),
]
Team = Annotated[
    str,
    typer.Option(
        metavar="request|group|@NAME|swarm",
        help="Robots that the control law counts as neighbours: those of this request, of its group, of a group, or "
        "all (default: as the behaviour's record says).",
    ),
]
NeedsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--needs",
        metavar="KEY=VALUE",
        help="What robots must be able to do: capabilities=gripper, speed_m_s=0.3, makes=iRobot, battery=0.5. Others "
        "are left out, or refused if they are named.",
    ),
]
RolesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--role", metavar="ROLE=A,B", help="Give a role to robots, @groups or +capabilities: carrier=r1,+gripper."
    ),
]
Stick = Annotated[float, typer.Option(min=-1, max=1, help="Share of the robot's full rate, -1 to 1.")]


# ---------------------------------------------------------------- request
@shell_command()
def request(
    target: NamedTarget,
    behaviour: Requested,
    robots: Robots = None,
    settings: Settings = None,
    wait: Annotated[
        bool | None,
        typer.Option(
            "--wait/--no-wait",
            show_default=False,
            help="Wait for the robots' answers until --timeout, or not at all (default: for 2 s at most). "
            "A mission: follow it until it ends (default: do not).",
        ),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Check a mission file and start nothing.")] = False,
    until_end: Annotated[
        bool,
        typer.Option("--until-end", help="Wait until the behaviour has ended on all robots; Ctrl-C leaves it running."),
    ] = False,
    team: Team = "",
    needs: NeedsOption = None,
    roles: RolesOption = None,
    take: Take = False,
    timeout: Timeout = 5.0,
    as_json: Json = False,
) -> int:
    """Request a behaviour and print what the robots answer, or start the mission of a file.

    Exit code 0: all robots present run it, or have arrived; 1: one refused, failed or did not answer; 2: the core
    refused; 3: no hub or no core; 4: a latched e-stop is in the way. With --no-wait 0: the core accepted. With
    --until-end 0: all have arrived.
    """
    import msgspec

    from fullswarm.operator import session
    from fullswarm.operator.outcome import all_arrived, ended, refusal, settled, unconfirmed

    if check or is_mission(behaviour):
        check_options(behaviour, given=bool(robots or settings or team or needs or roles))
        follow = bool(wait) or until_end
        return start(target, Path(behaviour), check=check, wait=follow, take=take, timeout=timeout, as_json=as_json)
    parameters, ids = parse_parameters(settings or ()), robot_ids(robots, groups=True)
    needed, given_roles = parse_needs(needs or ()), parse_roles(roles or ())
    newest: RequestStatus | None = None
    shown = ""
    with session.connect(target) as connection:

        def receive(status: RequestStatus) -> None:
            nonlocal newest, shown
            if newest is None and wait is None and not until_end:
                connection.runtime.after(ANSWER_S, connection.finish)
            newest = status
            text = f"{status.phase}: {len(status.running)} of {len(status.robots)} confirmed"
            if status.results:
                text = f"{status.phase}: {len(status.results)} of {len(status.robots)} ended"
            if (wait or until_end) and status.phase != "refused" and text != shown:  # the core repeats it
                output.progress(text)
                shown = text
            if ended(status) if until_end else wait is False or settled(status):
                connection.finish()

        if until_end:
            connection.on_interrupt = connection.finish
            connection.runtime.after(timeout, lambda: None if newest else connection.finish())
        connection.operator.request(
            behaviour, ids, parameters, receive, take=take, team=team, needs=needed, roles=given_roles
        )
        connection.run(None if until_end else timeout)
        if newest is None:
            raise connection.no_core(timeout)
    if as_json:
        output.data_json(msgspec.to_builtins(newest))
    elif newest.phase != "refused":
        output.data("\n".join(status_lines(newest)))
    if newest.phase == "refused":
        raise refusal(newest)
    if newest.phase == "ended" and newest.results:
        return 0 if all_arrived(newest) else 1
    confirmed = newest.phase == "running" and settled(newest) and not newest.refused_by
    if not until_end and (wait is False or confirmed):
        return 0
    late = unconfirmed(newest)
    if late and not settled(newest):
        within_s = timeout if wait or until_end else min(ANSWER_S, timeout)
        output.progress(f"not confirmed within {within_s:g} s: {', '.join(late)}")
    return refusal(newest).exit_code if newest.refused_by else 1


def status_lines(status: RequestStatus) -> list[str]:
    """Return a request's status as text, the robots by name."""
    robots = ", ".join(status.robots) or "no robot"
    lines = [f"{status.phase} {status.request_id}: {status.behaviour} for {robots}"]
    if status.reason:
        lines.append(f"reason: {status.reason}")
    for title, names in (
        ("confirmed by", status.running),
        ("refused by", status.refused_by),
        ("left out", status.left_out),
        ("missing, will get it when they join", status.missing),
    ):
        if names:
            lines.append(f"{title}: {', '.join(names)}")
    lines += [
        f"{role}: {', '.join(robot for robot, each in status.roles.items() if each == role)}"
        for role in dict.fromkeys(status.roles.values())
    ]
    lines += [f"{each.robot}: {each.outcome}" + (f", {each.text}" if each.text else "") for each in status.results]
    return lines


# ---------------------------------------------------------------- mock
@shell_command()
def mock(
    target: NamedTarget,
    behaviour: Behaviour,
    rate: Annotated[float, typer.Option(min=0.01, max=200, help="Requests per second.")] = 1.0,
    count: Annotated[int, typer.Option(min=0, help="Number of requests; 0: until Ctrl-C.")] = 1,
    robots: Robots = None,
    settings: Settings = None,
    timeout: Timeout = 5.0,
) -> int:
    """Send the same request repeatedly (the paper's mock publisher) and print the outcome of each."""
    from fullswarm.operator import session
    from fullswarm.operator.client import MockPublisher
    from fullswarm.operator.outcome import refusal

    parameters, ids = parse_parameters(settings or ()), robot_ids(robots, groups=True)
    with session.connect(target) as connection:
        publisher = MockPublisher(
            connection.operator,
            connection.runtime,
            behaviour,
            ids,
            parameters,
            rate_hz=rate,
            count=count,
            on_status=lambda status: output.data(status_lines(status)[0]),
            on_answered=connection.finish,
        )
        connection.on_interrupt = connection.finish
        publisher.start()
        # Without a count only Ctrl-C ends it.
        connection.run(count / rate + timeout if count else None)
        output.progress(f"{publisher.sent} sent, {publisher.answered} answered, {len(publisher.refused)} refused")
        if publisher.answered == 0:
            raise connection.no_core(timeout)
        if publisher.refused:
            raise refusal(publisher.refused[0])
    return 0 if publisher.answered == publisher.sent else 1


# ---------------------------------------------------------------- drive, stop
@shell_command()
def drive(
    target: NamedTarget,
    linear: Stick = 0.0,
    angular: Stick = 0.0,
    robots: Robots = None,
    seconds: Annotated[float | None, typer.Option(min=0.05, help="Stop after this time (default: on Ctrl-C).")] = None,
    take: Take = False,
    timeout: Timeout = 3.0,
) -> int:
    """Drive robots by hand until Ctrl-C, then stop them. Robots that are named are held meanwhile.

    Exit code 1: another operator stopped them.
    """
    from fullswarm.messages import EStop, StopRequest
    from fullswarm.operator import session
    from fullswarm.operator.leases import LeaseHolder
    from fullswarm.operator.outcome import refusal
    from fullswarm.operator.teleop import BEHAVIOUR, Teleop

    refused: RequestStatus | None = None
    answered = False
    stopped = ""
    ids = robot_ids(robots, groups=True)
    driven = set(ids)
    with session.connect(target) as connection:

        def receive(status: RequestStatus) -> None:
            nonlocal refused, answered
            answered, teleop.take = True, False  # taken once; an operator that takes it back keeps it
            driven.update(status.robots)
            if status.phase == "refused" and refused is None:
                refused = status
                end()

        def check() -> None:
            if not answered:
                end()

        def end() -> None:
            teleop.release(connection.finish)

        def halted(order: StopRequest | EStop) -> None:
            nonlocal stopped
            if teleop.held and (not order.robots or not driven.isdisjoint(order.robots)):
                stopped = order.source or "an operator"
                end()

        connection.bus.subscribe(connection.keys.stop, StopRequest, halted)
        connection.bus.subscribe(connection.keys.estop, EStop, halted)  # its release too: it must not start them
        holder = LeaseHolder(connection.bus, connection.keys, connection.runtime, connection.operator.name)
        teleop = Teleop(connection.operator, connection.runtime, ids, on_status=receive)
        connection.on_interrupt = end
        holder.hold(ids, take=take)
        teleop.take = take  # a frame may overtake the lease request
        teleop.hold(BEHAVIOUR, {"linear": linear, "angular": angular})
        connection.runtime.after(timeout, check)
        if seconds is not None:
            connection.runtime.after(seconds, end)
        else:
            output.progress("driving; Ctrl-C stops")
        connection.run()
        holder.close()
        if refused is not None:
            raise refusal(refused)
        if not answered:
            raise connection.no_core(timeout)
    if stopped:
        output.progress(f"stopped by {stopped}")
        return 1
    return 0


@shell_command()
def stop(target: Target, robots: RobotArguments = None) -> int:
    """Stop robots now, whatever they do. They start again on the next request."""
    from fullswarm.operator import session

    ids = robot_ids(robots)
    with session.connect(target) as connection:
        burst = connection.operator.stop(ids, on_done=connection.finish)
        connection.run()
        if not burst.done:
            raise Unreachable(
                "the hub was lost before the stop was sent",
                where=connection.hub,
                hint="robots that lost the hub stop by themselves; repeat the command",
            )
    output.progress(f"stop sent to {', '.join(ids) or 'all robots'}")
    return 0
