"""Speed and turn rate that can still be brought to zero before a gap is used up.

A body gains and loses at most `accel` of speed and `turn_accel` of turn rate per second, so what the certificates ask
for now may come too late: at full speed beside a wall a turn towards it needs more brakes than there are. From speed v
and turn rate w a robot that lets go of both goes v²/2a further, and its heading turns by w²/2α. Whatever the timing,
it comes nearer to a thing in direction n by at most v²/2a times the greatest ``n·h`` of the headings h in that fan.
A step is taken only if that, with the way of the step itself, fits into the room that is left; letting go always
keeps what held before, so there is always something to do (the proof is in ``docs/explanation-safety-filter.md``).
"""

from __future__ import annotations

import math

from fullswarm.agent.safety.barrier import HalfPlanes
from fullswarm.geometry import clamp
from fullswarm.kernels import kernel

SLACK_M = 1e-7


@kernel
def towards(now: float, desired: float, step: float) -> float:
    """Return what `now` becomes on its way to `desired` in steps of `step`; zero is not jumped over."""
    least = now - step
    most = now + step
    then = most if desired > most else (least if desired < least else desired)
    # A value below a quarter of a step is noise of the sensor, not motion.
    if then * now < 0.0 and math.fabs(now) > 0.25 * step:
        return 0.0
    return then


@kernel
def stop_distance(speed: float, most: float, period_s: float) -> float:
    """Return how far a body goes that loses `most` of its speed >= 0 per second, in commands of one period each.

    That is v²/2a where the stop takes whole periods. The last command may take less speed than a period could, and
    the body then glides for all of it.
    """
    rest = speed - most * period_s * math.floor(speed / (most * period_s))
    return 0.5 * (speed * speed / most + rest * (period_s - rest / most))


@kernel
def way(now: float, then: float, most: float, period_s: float) -> float:
    """Return how far it goes from `now` over `then`, one period later, down to zero at `most` per s².

    Either may jump to its new value at the start of the period or glide there: the longer way counts.
    """
    before = math.fabs(now) if now * then > 0.0 or then == 0.0 else 0.0
    after = math.fabs(then)
    mean = 0.5 * (before + after)
    return (mean if mean > after else after) * period_s + stop_distance(after, most, period_s)


@kernel
def rate_within(angle: float, periods: float, most: float, period_s: float) -> float:
    """Return the rate at which `periods` periods and the stop after them, see :func:`stop_distance`, take `angle`."""
    # The stop from k whole steps and a rest takes (k² step / 2 + (k + 1/2) rest) T: linear between whole steps.
    step = most * period_s
    whole = math.floor(math.sqrt(periods * periods + 2.0 * angle / (step * period_s)) - periods)
    left = angle - step * period_s * whole * (0.5 * whole + periods)
    return whole * step + (left if left > 0.0 else 0.0) / ((whole + 0.5 + periods) * period_s)


@kernel
def fastest(angle: float, now: float, most: float, period_s: float) -> float:
    """Return the turn rate >= 0 one period from `now` whose :func:`way` is `angle`; -1 when there is none."""
    if angle < 0.0:
        return -1.0
    rate = rate_within(angle, 1.0, most, period_s)
    if rate >= now:
        return rate
    angle -= 0.5 * now * period_s
    if angle < 0.0:
        return -1.0
    return rate_within(angle, 0.5, most, period_s)


@kernel
def free_fan(heading: float, distance: float, planes: HalfPlanes, count: int) -> tuple[float, float]:
    """Return by how much the robot may turn to the left and to the right while it goes `distance` and stops.

    Parameters
    ----------
    heading : rad, of the motion: backwards when it reverses
    distance : m

    Returns
    -------
    left, right
        rad, >= 0; infinite where nothing is near; both -1 when even straight on there is no room.
    """
    normal_x, normal_y, _, blur, room = planes
    left = math.inf
    right = math.inf
    for k in range(count):
        if distance * (1.0 + blur[k]) <= room[k] + SLACK_M:
            continue
        nx = normal_x[k]
        ny = normal_y[k]
        steepest = (room[k] + SLACK_M) / distance - blur[k]
        cos_heading = math.cos(heading)
        sin_heading = math.sin(heading)
        slope = nx * cos_heading + ny * sin_heading
        if steepest < -1.0 or slope > steepest:
            return -1.0, -1.0
        # Headings nearer to the normal than `near` are forbidden.
        near = math.acos(min(steepest, 1.0))
        side = math.atan2(cos_heading * ny - sin_heading * nx, slope)
        other_side = 2.0 * math.pi - math.fabs(side)
        left = min(left, (side if side >= 0.0 else other_side) - near)
        right = min(right, (-side if side < 0.0 else other_side) - near)
    return 0.0 if left < 0.0 else left, 0.0 if right < 0.0 else right


@kernel
def fitting_turn(
    heading: float, distance: float, turn: float, turn_now: float, turn_accel: float, period_s: float,
    planes: HalfPlanes, count: int,
) -> tuple[float, bool]:  # fmt: skip
    """Return the turn rate nearest to `turn` that :func:`free_fan` leaves, and whether there is one at all."""
    left, right = free_fan(heading, distance, planes, count)
    if left < 0.0:
        return turn, False
    if left == right == math.inf:
        return turn, True
    fastest_left = math.inf
    fastest_right = math.inf
    if left < math.inf:
        fastest_left = fastest(left, max(turn_now, 0.0), turn_accel, period_s)
    if right < math.inf:
        fastest_right = fastest(right, max(-turn_now, 0.0), turn_accel, period_s)
    if fastest_left < 0.0 or fastest_right < 0.0:
        return turn, False
    return clamp(turn, -fastest_right, fastest_left), True


@kernel
def stoppable(
    heading: float, speed: float, turn: float, speed_now: float, turn_now: float, accel: float, turn_accel: float,
    period_s: float, planes: HalfPlanes, count: int,
) -> tuple[float, float, bool]:  # fmt: skip
    """Return the speed and turn rate for the next period, and False when not even braking fits into the room.

    Turning goes before speed: where both do not fit, the robot brakes, and turns as far as braking allows.
    """
    step = accel * period_s
    turn_step = turn_accel * period_s
    then = towards(speed_now, speed, step)
    turn_then = towards(turn_now, turn, turn_step)
    if then == 0.0 and speed_now * speed < 0.0:
        speed = 0.0
    distance = way(speed_now, then, accel, period_s)
    if distance <= 0.0:
        return speed, turn, True
    ahead = heading if then > 0.0 or (then == 0.0 and speed_now > 0.0) else heading + math.pi
    fitting, fits = fitting_turn(ahead, distance, turn_then, turn_now, turn_accel, period_s, planes, count)
    if fits and fitting == turn_then:
        return speed, turn, True
    then = towards(speed_now, 0.0, step)
    distance = way(speed_now, then, accel, period_s)
    if distance <= 0.0:
        return 0.0, turn, True
    ahead = heading if speed_now > 0.0 else heading + math.pi
    fitting, fits = fitting_turn(ahead, distance, turn_then, turn_now, turn_accel, period_s, planes, count)
    reachable = clamp(fitting, turn_now - turn_step, turn_now + turn_step)
    if fits and math.fabs(reachable - fitting) < 1e-3:
        return 0.0, reachable, True
    return 0.0, 0.0, False
