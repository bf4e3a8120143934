"""Implements `fullswarm results audit`: compares what trials report with a recount of the evidence that they stored."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fullswarm import output
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.outcomes import Outcome
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.results.folder import StoredTrial, read_folder
from fullswarm.evaluate.results.recount import Recount, recount
from fullswarm.evaluate.trial_folder import (
    EVIDENCE_FILE,
    PROVENANCE_FILE,
    TRAJECTORY_FILE,
    Record,
    decode,
    digest_of,
    read_evidence,
    read_record,
    read_trajectory,
)

Verdict = Literal["agrees", "differs", "no motion", "no evidence"]
Arrays = dict[str, NDArray[Any]]
REAL_TIME = ("live", "fleet")
"""Runners whose clock is not the one that the bodies move by."""
LATE_S, LATE = 1.0, 0.05
"""So much, and such a part of it, the two clocks of a real-time trial may differ."""
CHECK_S = 0.1
"""How often it is looked whether all have arrived: a trial goes on for so long afterwards at most."""
READING_M = 2e-5
"""Rounding of the stored positions and closest approaches."""


@dataclass(slots=True)
class Audited:
    """What the recount of a trial says."""

    id: str
    verdict: Verdict
    differences: list[str] = field(default_factory=list)
    steps: int = 0
    undecided: int = 0  # pairs and steps whose gap is nearer to the touching one than the recount can see
    bound_m: float = 0.0  # how far two bodies together may be off the ways that the recount takes, at most
    source: str = ""
    evidence_bytes: int = 0


def audit(folder: Path, as_json: bool, jobs: int) -> int:
    """Recount the trials of a folder and print what comes of it; return 1 if any differs.

    Raises
    ------
    ConfigError
        No trial in it has kept its motion, so that nothing can be recounted.
    """
    read = read_folder(folder)
    trials = [each for each in read.trials if each.record.outcome is not None]
    found = []
    with output.Progress("trials", len(trials), at_once=len(trials) > 1) as progress:
        progress.at(0)
        for each in _audit_all(trials, jobs):
            found.append(each)
            progress.at(len(found))
    counts = {name: sum(each.verdict == name for each in found) for name in get_args(Verdict)}
    if as_json:
        problems = [{"directory": str(each.path), "reason": each.reason} for each in read.problems]
        output.data_json({**counts, "trials": [_plain(each) for each in found], "problems": problems})
    else:
        for each in found:
            _print(each)
        undecided = sum(each.undecided for each in found)
        words = ", ".join(f"{count} {name}" for name, count in counts.items())
        output.data(f"{len(found)} trials: {words}; {undecided} pairs and steps undecided")
    for problem in read.problems:
        output.progress(f"unreadable: {problem.path}: {problem.reason}")
    if not counts["agrees"] and not counts["differs"]:
        raise ConfigError(
            "no trial has kept its motion, so nothing can be recounted",
            where=str(folder),
            hint="run the experiment with --evidence always, into another folder",
        )
    return int(counts["differs"] > 0 or bool(read.problems))


NOT_RECOUNTED: tuple[Verdict, ...] = ("no motion", "no evidence")


def _audit_all(trials: list[StoredTrial], jobs: int) -> Iterator[Audited]:
    paths = [each.path for each in trials]
    if jobs == 1 or len(paths) < 2:
        yield from map(audit_trial, paths)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        yield from pool.map(audit_trial, paths)


def _print(each: Audited) -> None:
    facts = f"{each.steps} steps, {each.undecided} undecided, within {1000.0 * each.bound_m:.2f} mm"
    if each.verdict in NOT_RECOUNTED:
        facts = "nothing to recount" if each.verdict == "no evidence" else "closest approaches alone agree"
    elif each.source != "world":
        facts += f", poses by {each.source}"
    output.data(f"{each.verdict:11} {each.id}  {facts}")
    for difference in each.differences:
        output.data(f"            {difference}")


def _plain(each: Audited) -> dict[str, Any]:
    plain = asdict(each)
    return {**plain, "bound_m": round(each.bound_m, 7)}


# ---------------------------------------------------------------------------------------------------- one trial
def audit_trial(folder: Path) -> Audited:
    """Compare the result of a trial with its evidence."""
    record = read_record(folder)
    outcome = None if record is None else record.outcome
    if record is None or outcome is None:
        return Audited(folder.name, "differs", ["result.json cannot be read, or has no outcome"])
    if not (folder / EVIDENCE_FILE).exists():
        return Audited(record.id, "no evidence")
    try:
        stored = read_evidence(folder)
    except ConfigError as error:
        return Audited(record.id, "differs", [str(error)])
    about = _provenance(folder)
    found = Audited(record.id, "agrees", source=str(stored["source"]))
    found.evidence_bytes = (folder / EVIDENCE_FILE).stat().st_size
    try:
        found.differences += _nearest(record, outcome, stored)
        if about.evidence and about.evidence != digest_of(stored):
            found.differences.append("evidence.npz is not the file of which provenance.json has the digest")
        if len(stored["xy"]):
            counted = recount(stored)
            found.steps, found.undecided = counted.steps, counted.undecided
            found.bound_m = float(np.sort(counted.bound_m)[-2:].sum())
            found.differences += _compare(record, outcome, stored, counted, about.runner in REAL_TIME)
            found.differences += _trajectory(folder, stored, about.runner in REAL_TIME)
    except (IndexError, ValueError) as error:  # arrays that do not belong together
        found.differences.append(f"the arrays of evidence.npz do not fit each other: {error}")
    if found.differences:
        found.verdict = "differs"
    elif not len(stored["xy"]):
        found.verdict = "no motion"
    return found


def _provenance(folder: Path) -> Provenance:
    try:
        return decode(folder / PROVENANCE_FILE, Provenance)
    except ConfigError:
        return Provenance()


def _nearest(record: Record, outcome: Outcome, stored: Arrays) -> Iterator[str]:
    """Compare counts and figures with the stored closest approaches, which every trial has."""
    touch_m = float(stored["touch_m"])
    touched = int((stored["closest_m"] <= np.float32(touch_m)).sum())
    if outcome.pairs_touched is not None and outcome.pairs_touched != touched:
        yield f"pairs_touched is {outcome.pairs_touched}, but {touched} pairs came within {touch_m} m"
    if str(stored["source"]) == "world":
        robot_events = outcome.robot_events + outcome.pushed_events
        if (robot_events > 0) != (touched > 0):
            yield f"robot_events and pushed_events are {robot_events} in all, but {touched} pairs of robots touched"
        walls = int((stored["wall_m"] <= np.float32(touch_m)).sum())
        if (outcome.obstacle_events > 0) != (walls > 0):
            yield f"obstacle_events is {outcome.obstacle_events}, but {walls} pairs of robot and obstacle touched"
    figures = (
        ("separation.min_m", outcome.separation_m, float(stored["closest_m"].min(initial=np.inf))),
        ("clearance.min_m", outcome.clearance_m, float(stored["wall_m"].min(initial=np.inf))),
        ("time_to_contact.min_s", outcome.time_to_contact_s, float(stored["soonest"][0])),
    )
    for name, counted, value in figures:
        said = record.approaches.get(name)
        for each in (counted, None if said is None else said.value):
            if not math.isclose(math.inf if each is None else each, value, rel_tol=1e-6, abs_tol=1e-7):
                yield f"{name} is {'absent' if each is None else each}, the evidence has {value:.7g}"


def _compare(
    record: Record, outcome: Outcome, stored: Arrays, counted: Recount, real_time: bool
) -> Iterator[str]:  # fmt: skip
    """Yield where a result and its recount contradict each other, or the evidence contradicts itself."""
    yield from counted.contradictions
    if str(stored["source"]) == "world":
        robots = outcome.robot_events + outcome.pushed_events
        if not counted.robot_events.holds(robots):
            yield f"robot_events and pushed_events are {robots} in all, recounted {counted.robot_events}"
        if not counted.pushed_events.holds(outcome.pushed_events):
            yield f"pushed_events is {outcome.pushed_events}, recounted {counted.pushed_events}"
        for name in ("obstacle_events", "pairs_touched", "robots_touched"):
            said, of = getattr(outcome, name), getattr(counted, name)
            if said is not None and not of.holds(said):
                yield f"{name} is {said}, recounted {of}"
        by_movers = outcome.mover_events + outcome.mover_hits
        if not counted.mover_contacts.holds(by_movers):
            yield f"mover_events and mover_hits are {by_movers} in all, recounted {counted.mover_contacts}"
        if counted.commands_known and outcome.above_limits != counted.above_limits:
            yield f"above_limits is {outcome.above_limits}, recounted {counted.above_limits}"
    if not counted.arrived.holds(outcome.arrived):
        yield f"arrived is {outcome.arrived}, recounted {counted.arrived}"
    yield from _times(record, outcome, counted, float(stored["step_s"]), real_time)
    yield from _gaps(stored, counted)


def arrival_problem(counted: Recount, end_s: float, slack_s: float) -> Iterator[str]:
    """Yield why a trial cannot have ended at `end_s` because all had arrived.

    A trial looks each `CHECK_S`: it may miss that all were at their goals for a shorter time.
    """
    spans = counted.all_there_s
    seen = next((k for k, (from_s, to_s) in enumerate(spans) if to_s - from_s > CHECK_S + slack_s), len(spans))
    first_s = [from_s for from_s, _ in spans[: seen + 1]]
    if not any(-slack_s <= end_s - each <= CHECK_S + slack_s for each in first_s):
        recounted = ", ".join(f"{each:.3f}" for each in first_s) or "never"
        yield f"all arrived at {end_s} s, recounted {recounted}"


def _times(record: Record, outcome: Outcome, counted: Recount, step_s: float, real_time: bool) -> Iterator[str]:
    slack_s = LATE_S + LATE * counted.end_s if real_time else 1.05 * step_s
    if abs(outcome.simulated_s - counted.end_s) > slack_s:
        yield f"simulated_s is {outcome.simulated_s}, but the motion ends at {counted.end_s:.3f} s"
    if record.end_reason == "all arrived":
        yield from arrival_problem(counted, outcome.simulated_s, slack_s)
    said_s = record.truth.get("arrival.last_s")
    if real_time or said_s is None:  # robots of a real-time trial are watched until they stand
        return
    if math.isnan(counted.last_arrival_s) or abs(said_s - counted.last_arrival_s) > slack_s:
        yield f"arrival.last_s is {said_s:.3f} s, recounted {counted.last_arrival_s:.3f} s"


def _gaps(stored: Arrays, counted: Recount) -> Iterator[str]:
    """Compare closest approaches and the time to contact.

    The referee takes the ways of bodies that are far from each other as straight, also where one touches another.
    """
    ids, bound = [str(each) for each in stored["ids"]], counted.bound_m + counted.detour_m
    one, other = np.triu_indices(len(ids), 1)
    pairs = [(ids[i], ids[j]) for i, j in zip(one, other, strict=True)]
    yield from _gaps_of(pairs, stored["closest_m"], counted.closest_m, bound[one] + bound[other])
    count = counted.wall_m.shape[1]
    walls = [(robot, f"obstacle {k}") for robot in ids for k in range(count)]
    yield from _gaps_of(walls, stored["wall_m"].ravel(), counted.wall_m.ravel(), np.repeat(bound, count))
    soonest_s, (least_s, most_s) = float(stored["soonest"][0]), counted.time_to_contact_s
    if not least_s - 1e-6 <= soonest_s <= most_s + 1e-6:
        yield f"least time to contact is {soonest_s:.4f} s, recounted {least_s:.4f} to {most_s:.4f} s"


def _gaps_of(
    names: list[tuple[str, str]], said: NDArray[Any], again: NDArray[Any], off: NDArray[Any]
) -> Iterator[str]:  # fmt: skip
    both = np.isfinite(said) & np.isfinite(again)
    wrong = np.isfinite(said) != np.isfinite(again)
    wrong[both] = np.abs(said[both] - again[both]) > off[both] + READING_M + 1e-6 * np.abs(again[both])
    for at in np.flatnonzero(wrong)[:3].tolist():
        who = " and ".join(names[at])
        yield f"closest approach of {who} is {said[at]:.5f} m, recounted {again[at]:.5f} m"


def _trajectory(folder: Path, stored: Arrays, real_time: bool) -> Iterator[str]:
    """Compare the motion with the trajectory, which was sampled apart."""
    if real_time or not (folder / TRAJECTORY_FILE).exists():
        return
    track = read_trajectory(folder)
    xy = np.cumsum(stored["xy"], axis=0, dtype=np.int32) * 1e-5
    rows = np.round(track.time_s / float(stored["step_s"])).astype(int)
    if len(rows) and (rows.max() >= len(xy) or track.ids != tuple(stored["ids"].tolist())):
        yield "trajectory.npz is of another motion: it has other robots, or is longer"
        return
    size = np.abs(xy[rows]).max(axis=2, initial=0.0)
    off = np.abs(track.pose[:, :, :2] - xy[rows]).max(axis=2, initial=0.0)
    for row, robot in np.argwhere(off > READING_M + 1e-6 * size)[:3].tolist():
        where = f"{track.ids[robot]} at {track.time_s[row]:.2f} s"
        yield f"{where} is elsewhere in trajectory.npz, by {off[row, robot]:.4f} m"
