"""The commands that make robots do something: request, stop, drive, mock. Each returns its exit code."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import msgspec

from fullswarm import output
from fullswarm.errors import ConfigError, FullswarmError, RequestRefused, SafetyStop, Unreachable
from fullswarm.keys import ROBOT_ID
from fullswarm.messages import EStop, RequestStatus, StopRequest, Value
from fullswarm.operator import session
from fullswarm.operator.leases import GROUP, LeaseHolder
from fullswarm.operator.mock import MockPublisher
from fullswarm.operator.session import Target
from fullswarm.operator.teleop import BEHAVIOUR, Teleop
from fullswarm.reasons import Code, holds

ANSWER_S = 2.0
"""For the robots to answer a request that the core accepted; they do within 0.1 s unless messages are lost."""


def robot_ids(names: Iterable[str], *, groups: bool = False) -> tuple[str, ...]:
    """Return the ids in ``a,b c`` and the like, each once; none means all.

    Parameters
    ----------
    groups
        Take ``@name`` too: for what goes through the core, which knows the members of a group.

    Raises
    ------
    ConfigError
        A name that no robot can have, or a group where robots are asked directly.
    """
    ids = [part.strip() for name in names for part in name.split(",")]
    for each in ids:
        if each.startswith(GROUP) and not groups:
            raise ConfigError(
                f"'{each}' is a group, and this goes straight to the robots, which know no groups",
                hint="name the robots, or none to mean all of them",
            )
        if not ROBOT_ID.match(each.removeprefix(GROUP)):
            raise ConfigError(f"'{each}' cannot name a robot", where="--robots", hint="e.g. --robots r1,r2")
    return tuple(dict.fromkeys(ids))


def request(
    target: Target,
    behaviour: str,
    robots: Iterable[str],
    parameters: Mapping[str, Value],
    *,
    wait: bool | None,
    timeout_s: float,
    as_json: bool,
    take: bool = False,
) -> int:
    """Ask for a behaviour and print which robots run it and which refused, and why.

    Parameters
    ----------
    wait
        For the answers of all present robots: True until `timeout_s`, None for `ANSWER_S` after the core's answer,
        False not at all.
    """
    ids = robot_ids(robots, groups=True)
    newest: RequestStatus | None = None
    told = ""
    with session.connect(target) as line:

        def receive(status: RequestStatus) -> None:
            nonlocal newest, told
            if newest is None and wait is None:
                line.runtime.after(ANSWER_S, line.finish)
            newest = status
            text = f"{status.phase}: {len(status.running)} of {len(status.robots)} confirmed"
            if wait and status.phase != "refused" and text != told:  # the core repeats it
                output.progress(text)
                told = text
            if wait is False or settled(status):
                line.finish()

        line.operator.request(behaviour, ids, parameters, receive, take=take)
        line.run(timeout_s)
        if newest is None:
            raise line.no_core(timeout_s)
    if as_json:
        output.data_json(msgspec.to_builtins(newest))
    elif newest.phase != "refused":
        output.data("\n".join(status_lines(newest)))
    if newest.phase == "refused":
        raise refusal(newest)
    if wait is False or (newest.phase == "running" and settled(newest) and not newest.refused_by):
        return 0
    late = unconfirmed(newest)
    if late and not settled(newest):
        within_s = timeout_s if wait else min(ANSWER_S, timeout_s)
        output.progress(f"not confirmed within {within_s:g} s: {', '.join(late)}")
    return refusal(newest).exit_code if newest.refused_by else 1


def refusal(status: RequestStatus) -> FullswarmError:
    """Return the error for a request that the core refused, or robots."""
    if status.refused_by:
        latched = holds(status.code, status.parameters, Code.ESTOP_LATCHED)
        kind = SafetyStop if latched else FullswarmError
        return kind(status.reason, where=status.behaviour)
    # The core's reason mostly ends with what to do; two hints would be one too many.
    hint = "" if status.reason.endswith(")") else "`fullswarm behaviours` shows what can be asked for"
    return RequestRefused(status.reason or "refused without a reason", where=status.behaviour, hint=hint)


def unconfirmed(status: RequestStatus) -> tuple[str, ...]:
    """Return the robots that are present and have not answered yet."""
    answered = {*status.running, *status.refused_by, *status.missing}
    return tuple(robot for robot in status.robots if robot not in answered)


def settled(status: RequestStatus) -> bool:
    """Return whether nothing more is to be expected soon."""
    if status.phase in ("refused", "superseded", "ended"):
        return True
    return bool(status.running or status.refused_by) and not unconfirmed(status)


def status_lines(status: RequestStatus) -> list[str]:
    """Return a request's status in words, the robots by name."""
    robots = ", ".join(status.robots) or "no robot"
    lines = [f"{status.phase} {status.request_id}: {status.behaviour} for {robots}"]
    if status.reason:
        lines.append(f"reason: {status.reason}")
    for title, names in (
        ("confirmed by", status.running),
        ("refused by", status.refused_by),
        ("missing, will get it when they join", status.missing),
    ):
        if names:
            lines.append(f"{title}: {', '.join(names)}")
    return lines


def stop(target: Target, robots: Sequence[str]) -> int:
    """Tell robots to stand still."""
    ids = robot_ids(robots)
    with session.connect(target) as line:
        burst = line.operator.stop(ids, on_done=line.finish)
        line.run()
        if not burst.done:
            raise Unreachable(
                "the hub was lost before the stop was given",
                where=line.hub,
                hint="robots that lost it stand too; repeat",
            )
    output.progress(f"stop sent to {', '.join(ids) or 'all robots'}")
    return 0


def drive(
    target: Target,
    linear: float,
    angular: float,
    robots: Iterable[str],
    seconds: float | None,
    timeout_s: float,
    *,
    take: bool = False,
) -> int:
    """Stream the intent to drive for `seconds`, until Ctrl-C or until another operator stops them, then zero.

    Robots named are held meanwhile.
    """
    refused: RequestStatus | None = None
    answered = False
    stopped = ""
    ids = robot_ids(robots, groups=True)
    driven = set(ids)
    with session.connect(target) as line:

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
            teleop.release(line.finish)

        def halted(order: StopRequest | EStop) -> None:
            nonlocal stopped
            if teleop.held and (not order.robots or not driven.isdisjoint(order.robots)):
                stopped = order.source or "an operator"
                end()

        line.bus.subscribe(line.keys.stop, StopRequest, halted)
        line.bus.subscribe(line.keys.estop, EStop, halted)  # its release too: it must not start them
        holder = LeaseHolder(line.bus, line.keys, line.runtime, line.operator.name)
        teleop = Teleop(line.operator, line.runtime, ids, on_status=receive)
        line.on_interrupt = end
        holder.hold(ids, take=take)
        teleop.take = take  # a frame may overtake the word of the holder
        teleop.hold(BEHAVIOUR, {"linear": linear, "angular": angular})
        line.runtime.after(timeout_s, check)
        if seconds is not None:
            line.runtime.after(seconds, end)
        else:
            output.progress("driving; Ctrl-C stops")
        line.run()
        holder.close()
        if refused is not None:
            raise refusal(refused)
        if not answered:
            raise line.no_core(timeout_s)
    if stopped:
        output.progress(f"stopped by {stopped}")
        return 1
    return 0


def mock(
    target: Target,
    behaviour: str,
    robots: Iterable[str],
    parameters: Mapping[str, Value],
    *,
    rate_hz: float,
    count: int,
    timeout_s: float,
) -> int:
    """Send the same request again and again, print what became of each."""
    ids = robot_ids(robots, groups=True)
    with session.connect(target) as line:
        publisher = MockPublisher(
            line.operator,
            line.runtime,
            behaviour,
            ids,
            parameters,
            rate_hz=rate_hz,
            count=count,
            on_status=lambda status: output.data(status_lines(status)[0]),
            on_answered=line.finish,
        )
        line.on_interrupt = line.finish
        publisher.start()
        # Without an end in sight only Ctrl-C ends it.
        line.run(count / rate_hz + timeout_s if count else None)
        output.progress(f"{publisher.sent} sent, {publisher.answered} answered, {len(publisher.refused)} refused")
        if publisher.answered == 0:
            raise line.no_core(timeout_s)
        if publisher.refused:
            raise refusal(publisher.refused[0])
    return 0 if publisher.answered == publisher.sent else 1
