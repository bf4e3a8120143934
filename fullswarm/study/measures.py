"""Measures of a trial, computed from its log and its recording.

Definitions and sources; a robot is *addressed* by selecting it, by a request or a stop that concerns it, and by driving
it (an empty list of robots: all of them).

=========================  ====================================================================================
interaction episode        inputs to the same robots with gaps of at most `gap_s`; it lasts from its first input to
                           its last, `least_s` at least, and ends when other robots are addressed
interaction time IT        mean length of the episodes; also their sum, and both for each robot
neglect time               from the end of an episode with a robot to its next one or the end of the trial
neglect tolerance NT       how long a neglected robot stays effective: until its effectiveness falls below
                           `threshold`; right-censored by the next episode and the end of the trial. Estimated as
                           the restricted mean of the Kaplan-Meier curve over all neglects, the longest one included
robot attention demand     RAD = IT / (IT + NT)
fan-out                    FO = (IT + NT) / IT = 1 / RAD: robots that one operator can serve
attention switches         successive addressing inputs whose robots differ
probe accuracy             share of the probes answered correctly; not answered in time counts as wrong
workload                   NASA-TLX: raw, the mean of six ratings; weighted, by how often each won its comparisons
=========================  ====================================================================================

IT, NT, RAD and FO: D. R. Olsen and M. A. Goodrich, "Metrics for evaluating human-robot interactions", PERMIS 2003; J.
W. Crandall, M. A. Goodrich, D. R. Olsen and C. W. Nielsen, "Validating human-robot interaction schemes in multitasking
environments", IEEE Trans. SMC-A 35(4), 2005. Effectiveness by activity: D. R. Olsen and S. B. Wood, "Fan-out:
measuring human control of multiple robots", CHI 2004; here the mean speed of the last `window_s` over `speed_m_s`, at
most 1. NASA-TLX: S. G. Hart and L. E. Staveland, 1988. Probes: M. R. Endsley, 1995 (SAGAT, freeze); F. T. Durso and A.
R. Dattel, 2004 (SPAM, real time).

Times are those of the trial in s: they stand still while a probe freezes the world.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError
from fullswarm.operator.console.study import EVENTS, MOTION, Sample
from fullswarm.study.file import MeasuresSection

Array = NDArray[np.float64]
ADDRESSING = frozenset({"select", "request", "drive", "release", "stop", "estop"})
ALL: frozenset[str] = frozenset()
"""The robots of an input that names none: all of them."""


class Input(NamedTuple):
    """An input that addresses robots."""

    at_s: float
    robots: frozenset[str]


class Episode(NamedTuple):
    """A time of uninterrupted interaction with the same robots."""

    from_s: float
    to_s: float
    robots: frozenset[str]

    def concerns(self, robot: str) -> bool:
        """Whether `robot` is addressed."""
        return not self.robots or robot in self.robots


class Neglect(NamedTuple):
    """A time without interaction with a robot, and how long of it the robot stayed effective."""

    from_s: float
    to_s: float
    tolerated_s: float
    censored: bool  # it was still effective at the end


class Measure(NamedTuple):
    """One figure; `of`: the robot, probe or subscale that it belongs to, empty for the trial as a whole."""

    name: str
    of: str
    value: float | None
    unit: str = ""


@dataclass(frozen=True, slots=True)
class TrialLog:
    """What a trial recorded."""

    events: tuple[Mapping[str, Any], ...]
    motion: tuple[Sample, ...]

    @property
    def end_s(self) -> float:
        """When the task ended."""
        ends = [float(each["at_s"]) for each in self.events if each["kind"] == "end"]
        return ends[-1] if ends else (self.motion[-1].at_s if self.motion else 0.0)


def read_log(folder: Path) -> TrialLog:
    """Read what a trial recorded; a last line that was cut off is left out.

    Raises
    ------
    ConfigError
        A file is missing or no log.
    """
    return TrialLog(_lines(folder / EVENTS, dict[str, Any]), _lines(folder / MOTION, Sample))


def _lines(path: Path, kind: Any) -> tuple[Any, ...]:
    decoder = msgspec.json.Decoder(kind)
    try:
        lines = path.read_bytes().split(b"\n")
        return tuple(decoder.decode(line) for line in lines[:-1])
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(f"is no log of a trial: {error}", where=str(path), hint="restore it from a copy") from error


# ---------------------------------------------------------------- interaction
def inputs_of(events: Iterable[Mapping[str, Any]]) -> list[Input]:
    """Return the participant's inputs that address robots; clearing the selection addresses none."""
    return [
        Input(float(each["at_s"]), frozenset(each["robots"]))
        for each in events
        if each["kind"] in ADDRESSING and each.get("participant") and (each["robots"] or each["kind"] != "select")
    ]


def episodes_of(inputs: Sequence[Input], gap_s: float, least_s: float, end_s: float) -> list[Episode]:
    """Join inputs to episodes; see the table above. `end_s`: no episode lasts longer than the trial."""
    runs: list[list[Input]] = []
    for each in inputs:
        if runs and runs[-1][-1].robots == each.robots and each.at_s - runs[-1][-1].at_s <= gap_s:
            runs[-1].append(each)
        else:
            runs.append([each])
    found = []
    for run, after in zip(runs, [*(run[0].at_s for run in runs[1:]), end_s][: len(runs)], strict=True):
        to_s = max(run[-1].at_s, min(run[0].at_s + least_s, after))
        found.append(Episode(run[0].at_s, to_s, run[0].robots))
    return found


def switches_of(inputs: Sequence[Input]) -> int:
    """Count the attention switches."""
    return sum(one.robots != other.robots for one, other in itertools.pairwise(inputs))


# ---------------------------------------------------------------- neglect
def effectiveness(at_s: Array, speed_m_s: Array, window_s: float, full_m_s: float) -> Array:
    """Return the effectiveness of a robot at each sample, (n,), 0 to 1.

    Parameters
    ----------
    at_s, speed_m_s : times and speeds of a robot, (n,); NaN: unknown, counts as no motion
    window_s : the mean of the speed is taken over the last `window_s`
    full_m_s : speed at which a robot is fully effective
    """
    speed = np.nan_to_num(np.abs(speed_m_s))
    total = np.concatenate(([0.0], np.cumsum(speed)))
    first = np.searchsorted(at_s, at_s - window_s + 1e-9)
    number = np.arange(1, len(at_s) + 1)
    mean = (total[number] - total[first]) / (number - first)
    return np.asarray(np.minimum(1.0, mean / full_m_s), float)


def neglects_of(
    episodes: Sequence[Episode], robot: str, end_s: float, at_s: Array, effective: Array, settings: MeasuresSection
) -> list[Neglect]:
    """Return the times of neglect of a robot.

    A robot that was just sent off is not effective yet: it has `window_s` to become so, else it tolerated nothing.

    Parameters
    ----------
    at_s, effective : times and effectiveness of the robot, (n,)
    """
    mine = [each for each in episodes if each.concerns(robot)]
    found = []
    for one, next_s in zip(mine, [*(each.from_s for each in mine[1:]), end_s][: len(mine)], strict=True):
        if next_s <= one.to_s:
            continue
        within = (at_s >= one.to_s) & (at_s <= next_s)
        found.append(_neglect(one.to_s, next_s, at_s[within], effective[within] >= settings.threshold, settings))
    return found


def _neglect(from_s: float, to_s: float, at_s: Array, good: NDArray[np.bool_], settings: MeasuresSection) -> Neglect:
    rises = np.flatnonzero(good & (at_s <= from_s + settings.window_s))
    if not len(rises):
        # Cut off before it had the time to become effective: nothing is known of it.
        return Neglect(from_s, to_s, 0.0, to_s - from_s < settings.window_s)
    falls = np.flatnonzero(~good[rises[0] :])
    if not len(falls):
        return Neglect(from_s, to_s, to_s - from_s, True)
    return Neglect(from_s, to_s, float(at_s[rises[0] + falls[0]]) - from_s, False)


def restricted_mean(times_s: Sequence[float], censored: Sequence[bool]) -> float | None:
    """Return the mean of durations (k,) of which some are right-censored, s; None if there are none.

    It is the area under their Kaplan-Meier curve, up to the longest duration.
    """
    if not times_s:
        return None
    area = last_s = 0.0
    survival = 1.0
    for time_s in sorted(set(times_s)):
        area += survival * (time_s - last_s)
        at_risk = sum(each >= time_s for each in times_s)
        ended = sum(each == time_s and not cut for each, cut in zip(times_s, censored, strict=True))
        survival *= 1.0 - ended / at_risk
        last_s = time_s
    return area


def attention_demand(interaction_s: float, neglect_s: float) -> float | None:
    """Return RAD = IT / (IT + NT), 0 to 1; None: neither."""
    return interaction_s / (interaction_s + neglect_s) if interaction_s + neglect_s > 0.0 else None


def fan_out(interaction_s: float, neglect_s: float) -> float | None:
    """Return FO = (IT + NT) / IT; None: no interaction."""
    return (interaction_s + neglect_s) / interaction_s if interaction_s > 0.0 else None


# ---------------------------------------------------------------- probes and workload
def is_correct(truth: str, value: str, *, numeric: bool, tolerance: float) -> bool | None:
    """Return whether an answer is right; None: the truth is not known. An empty answer is wrong."""
    if not truth:
        return None
    if not numeric or not value:
        return value == truth
    return abs(float(value) - float(truth)) <= tolerance


def raw_tlx(ratings: Mapping[str, float]) -> float:
    """Return the mean of the six ratings, 0 to 100."""
    return sum(ratings.values()) / len(ratings)


def weighted_tlx(ratings: Mapping[str, float], weights: Mapping[str, int]) -> float:
    """Return the mean of the ratings weighed by won comparisons, 0 to 100; the weights of all pairs add up to 15."""
    return sum(weights[name] * rating for name, rating in ratings.items()) / sum(weights.values())


# ---------------------------------------------------------------- all of a trial
def measures_of(log: TrialLog, settings: MeasuresSection) -> list[Measure]:
    """Return all measures of a trial."""
    end_s = log.end_s
    inputs = inputs_of(log.events)
    episodes = episodes_of(inputs, settings.gap_s, settings.least_s, end_s)
    lengths = [each.to_s - each.from_s for each in episodes]
    found = [
        Measure("duration", "", end_s, "s"),
        Measure("interaction_episodes", "", len(episodes)),
        Measure("interaction_time_total", "", sum(lengths), "s"),
        Measure("interaction_time_mean", "", _mean(lengths), "s"),
        Measure("attention_switches", "", switches_of(inputs)),
    ]
    found += _inputs_by_kind(log.events)
    found += _neglect_measures(log, episodes, end_s, settings)
    found += _probe_measures(log.events)
    found += _workload(log.events)
    for each in log.events:
        if each["kind"] == "end":
            found += [
                Measure(f"{metric}_{name}", "", float(value))
                for metric, values in each.get("metrics", {}).items()
                for name, value in values.items()
            ]
    return found


def _inputs_by_kind(events: Iterable[Mapping[str, Any]]) -> list[Measure]:
    kinds = ("request", "drive", "stop", "estop", "mission", "select", "view")
    mine = [each["kind"] for each in events if each.get("participant")]
    return [Measure("inputs", kind, mine.count(kind)) for kind in kinds]


def _neglect_measures(log: TrialLog, episodes: list[Episode], end_s: float, settings: MeasuresSection) -> list[Measure]:
    found: list[Measure] = []
    everything: list[Neglect] = []
    for robot, (at_s, speed_m_s) in speeds_of(log.motion).items():
        mine = [each.to_s - each.from_s for each in episodes if each.concerns(robot)]
        effective = effectiveness(at_s, speed_m_s, settings.window_s, settings.speed_m_s)
        neglects = neglects_of(episodes, robot, end_s, at_s, effective, settings)
        everything += neglects
        found += [
            Measure("robot_interaction_time_total", robot, sum(mine), "s"),
            Measure("robot_neglect_time_mean", robot, _mean([each.to_s - each.from_s for each in neglects]), "s"),
            Measure("robot_neglect_tolerance", robot, _tolerance(neglects), "s"),
            Measure("robot_effectiveness_mean", robot, float(np.mean(effective)) if len(effective) else None),
        ]
    interaction_s = _mean([each.to_s - each.from_s for each in episodes])
    tolerance_s = _tolerance(everything)
    demand = fan = None
    if interaction_s is not None and tolerance_s is not None:
        demand, fan = attention_demand(interaction_s, tolerance_s), fan_out(interaction_s, tolerance_s)
    return [
        Measure("neglect_time_mean", "", _mean([each.to_s - each.from_s for each in everything]), "s"),
        Measure("neglect_tolerance", "", tolerance_s, "s"),
        Measure("neglects", "", len(everything)),
        Measure("neglects_censored", "", sum(each.censored for each in everything)),
        Measure("robot_attention_demand", "", demand),
        Measure("fan_out", "", fan),
        *found,
    ]


def speeds_of(motion: Iterable[Sample]) -> dict[str, tuple[Array, Array]]:
    """Return robot → times and speeds, (n,) each, in order; a speed that is not known is NaN."""
    found: dict[str, list[tuple[float, float]]] = {}
    for sample in motion:
        for each in sample.robots:
            speed_m_s = math.nan if each.speed_m_s is None or each.silent else each.speed_m_s
            found.setdefault(each.robot, []).append((sample.at_s, speed_m_s))
    return {
        robot: (np.array([at_s for at_s, _ in rows]), np.array([speed for _, speed in rows]))
        for robot, rows in sorted(found.items())
    }


def _tolerance(neglects: list[Neglect]) -> float | None:
    return restricted_mean([each.tolerated_s for each in neglects], [each.censored for each in neglects])


def _probe_measures(events: Iterable[Mapping[str, Any]]) -> list[Measure]:
    found, correct, times_s = [], [], []
    asked: Mapping[str, Any] = {}
    for each in events:
        if each["kind"] == "probe":
            asked = each
        elif each["kind"] == "answer" and asked:
            of = f"{asked['name']}@{asked['at_s']:.0f}"
            right = is_correct(
                asked["truth"], each["value"], numeric=asked["numeric"], tolerance=asked["tolerance"]
            )  # fmt: skip
            found.append(Measure("probe_correct", of, None if right is None else float(right)))
            correct += [] if right is None else [float(right)]
            if each["value"]:
                found.append(Measure("probe_response_time", of, each["response_s"], "s"))
                times_s.append(float(each["response_s"]))
            asked = {}
    if found:
        found.append(Measure("probe_accuracy", "", _mean(correct)))
        found.append(Measure("probe_response_time_mean", "", _mean(times_s), "s"))
    return found


def _workload(events: Iterable[Mapping[str, Any]]) -> list[Measure]:
    found = []
    for each in events:
        if each["kind"] == "tlx":
            found += [Measure("tlx_rating", name, float(value)) for name, value in each["ratings"].items()]
            found.append(Measure("tlx_raw", "", raw_tlx(each["ratings"])))
            if each["weights"] is not None:
                found += [Measure("tlx_weight", name, float(value)) for name, value in each["weights"].items()]
                found.append(Measure("tlx_weighted", "", weighted_tlx(each["ratings"], each["weights"])))
    return found


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
