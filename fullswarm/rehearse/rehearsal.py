"""Runs many episodes side by side, adds up what they tried, and reduces a failure to the fewest faults."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from functools import partial

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.errors import ConfigError
from fullswarm.logs import quiet
from fullswarm.output import Progress
from fullswarm.rehearse.episode import EPISODE_S, Result, faults_of, run

HOUR_S = 3600.0
SHRINK_RUNS = 24
"""At most so many episodes are run again to find the faults that matter."""
DIGITS = 4
IDLE_S = 1.0
ROBOTS = 8


@dataclass(frozen=True, slots=True)
class Options:
    """What to rehearse.

    Attributes
    ----------
    hours : simulated hours of the whole swarm
    episode, keep : run this one alone, with the faults of these indices (None: all)
    wall_s : begin no further episode after so many real seconds; None: run all
    reduce : look for the fewest faults that break the first failing episode
    """

    seed: int = 0
    hours: float = 0.1
    robots: int = ROBOTS
    only: tuple[str, ...] = ()
    episode: int | None = None
    keep: tuple[int, ...] | None = None
    episode_s: float = EPISODE_S
    jobs: int = 0
    wall_s: float | None = None
    reduce: bool = True


@dataclass(frozen=True, slots=True)
class Failure:
    """An episode that broke an invariant, and the indices of the fewest faults found that still do; None: as it is."""

    result: Result
    keep: tuple[int, ...] | None = None


@dataclass(slots=True)
class Report:
    """All that was tried and found."""

    options: Options
    results: list[Result] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)

    @property
    def hours(self) -> float:
        """Simulated hours of the swarm."""
        return sum(each.seconds for each in self.results) / HOUR_S

    def command(self, failure: Failure) -> str:
        """Return the command that repeats a failure."""
        options = self.options
        words = [f"fullswarm rehearse --seed {options.seed} --episode {failure.result.episode}"]
        if options.robots != ROBOTS:
            words.append(f"--robots {options.robots}")
        if options.only:
            words.append(f"--only {','.join(options.only)}")
        keep = failure.keep if failure.keep is not None else options.keep
        if keep is not None:
            words.append(f"--faults {','.join(map(str, keep)) or 'none'}")
        return " ".join(words)

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON; the same for the same options, whatever the machine."""
        faults, asked, messages = Counter[str](), Counter[str](), Counter[str]()
        for each in self.results:
            faults += each.faults
            asked += each.asked
            messages += each.messages
        return {
            "seed": self.options.seed,
            "robots": self.options.robots,
            "hours": round(self.hours, DIGITS),
            "episodes": len(self.results),
            "faults": dict(sorted(faults.items())),
            "asked": dict(sorted(asked.items())),
            "messages": dict(sorted(messages.items())),
            "restarts": sum(each.restarts for each in self.results),
            "set_points": sum(each.commands for each in self.results),
            "excused_contacts": sum(each.excused_contacts for each in self.results),
            "violations": sum(len(each.violations) for each in self.results),
            "failures": [
                {
                    "episode": each.result.episode,
                    "repeat": self.command(each),
                    "violations": [
                        {"at_s": one.at_s, "kind": one.kind, "robot": one.robot, "text": one.text}
                        for one in each.result.violations
                    ],
                }
                for each in self.failures
            ],
        }


def rehearse(options: Options, progress: Progress | None = None, clock: Clock | None = None) -> Report:
    """Run all episodes.

    Parameters
    ----------
    progress : shows how many episodes are done; None: it is not shown

    Raises
    ------
    ConfigError
        ``--faults`` without an episode, or an index that is none of its faults.
    """
    if options.episode is None and options.keep is not None:
        raise ConfigError("--faults needs --episode", hint="name the episode whose faults these are")
    if options.episode is not None and options.keep is not None:
        count = len(faults_of(options.seed, options.episode, options.robots, options.episode_s, options.only))
        wrong = [each for each in options.keep if not 0 <= each < count]
        if wrong:
            raise ConfigError(f"episode {options.episode} has no fault {wrong[0]}", where="--faults",
                              hint=f"0 to {count - 1}")  # fmt: skip
    report = Report(options)
    if options.episode is not None:
        numbers: Sequence[int] = (options.episode,)
    else:
        numbers = range(max(1, math.ceil(options.hours * HOUR_S / options.episode_s - 1e-9)))
    work = partial(
        _work, options.seed, robots=options.robots, seconds=options.episode_s, only=options.only, keep=options.keep
    )
    clock = clock or MonotonicClock()
    if progress:
        progress.parts(0, len(numbers))
    for result in _results(work, numbers, options, clock, progress.tick if progress else _not_shown):
        report.results.append(result)
        broken = sum(len(each.violations) for each in report.results)
        if progress:
            note = f"{report.hours:.2f} simulated hours, {broken} violation{'s' * (broken != 1)}"
            progress.parts(len(report.results), len(numbers), note)
    report.results.sort(key=lambda each: each.episode)
    for result in report.results:
        if result.violations:
            report.failures.append(Failure(result))
    if report.failures and options.keep is None and options.reduce:
        report.failures[0] = shrink(report.failures[0], options, progress.say if progress else _not_shown)
    return report


def _work(
    seed: int, episode: int, *, robots: int, seconds: float, only: tuple[str, ...], keep: tuple[int, ...] | None
) -> Result:
    return run(seed, episode, robots, seconds, only, keep)


def _be_quiet() -> None:
    """Log nothing: injected faults make nodes log thousands of errors."""
    quiet()


def _not_shown(_: str = "") -> None:
    """Take the place of what shows progress."""


def _results(
    work: Callable[[int], Result], numbers: Sequence[int], options: Options, clock: Clock, idle: Callable[[], None]
) -> Iterator[Result]:
    """Yield the results as they come, from as many processes as there are cores; call `idle` while waiting for them."""
    jobs = options.jobs or os.cpu_count() or 1
    if jobs == 1 or len(numbers) == 1:
        began_s = clock.now_s()
        for number in numbers:
            yield work(number)
            if options.wall_s is not None and clock.now_s() - began_s > options.wall_s:
                return
        return
    # Spawned: a fork would inherit what this process holds.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _be_quiet) as pool:
        began_s, waiting, left = clock.now_s(), set(), iter(numbers)
        for number in left:
            waiting.add(pool.submit(work, number))
            if len(waiting) == jobs:
                break
        while waiting:
            done, waiting = wait(waiting, IDLE_S, return_when=FIRST_COMPLETED)
            idle()
            for each in done:
                if options.wall_s is None or clock.now_s() - began_s < options.wall_s:
                    waiting |= {pool.submit(work, number) for number in itertools.islice(left, 1)}
                yield each.result()


def shrink(failure: Failure, options: Options, progress: Callable[[str], None]) -> Failure:
    """Leave out halves, quarters … of the faults as long as a violation of the same kind remains."""
    episode, kind = failure.result.episode, failure.result.violations[0].kind
    faults = faults_of(options.seed, episode, options.robots, options.episode_s, options.only)
    end_s = failure.result.violations[0].at_s
    kept = [each.index for each in faults]
    result = failure.result
    runs, parts = 0, 1
    candidates = [[each.index for each in faults if each.at_s <= end_s]] if kind not in ("last", "unanswered") else []
    while runs < SHRINK_RUNS and kept:
        if not candidates:
            parts = min(parts * 2, len(kept))
            size = math.ceil(len(kept) / parts)
            candidates = [kept[:at] + kept[at + size :] for at in range(0, len(kept), size)]
        while candidates and runs < SHRINK_RUNS:
            tried = candidates.pop(0)
            runs += 1
            found = run(options.seed, episode, options.robots, options.episode_s, options.only, tried)
            if any(each.kind == kind for each in found.violations):
                progress(f"{len(tried)} of {len(faults)} faults still break it")
                kept, result, parts, candidates = tried, found, max(1, parts // 2), []
                break
        else:
            if parts >= len(kept):
                break
    return Failure(result, tuple(kept))


def text_of(report: Report) -> str:
    """Return a report for people."""
    plain = report.as_dict()
    lines = [f"{report.hours:.2f} hours of {report.options.robots} robots in {len(report.results)} episodes"]
    for name in ("faults", "asked", "messages"):
        counts = plain[name]
        assert isinstance(counts, dict)  # noqa: S101  (narrows the type)
        lines.append(f"{name}: " + (", ".join(f"{count} {each}" for each, count in counts.items()) or "none"))
    lines.append(f"restarts: {plain['restarts']}, set-points judged: {plain['set_points']}, "
                 f"contacts excused: {plain['excused_contacts']}")  # fmt: skip
    lines.append(f"violations: {plain['violations']}")
    for each in report.failures:
        lines += [f"  {one.at_s:8.3f} s  {one.kind:10} {one.robot:6} {one.text}" for one in each.result.violations]
        lines.append(f"  repeat: {report.command(each)}")
    return "\n".join(lines)
