"""Sends pages the charts that they show: once as a whole, then the new samples; of now, or of a moment of the past.

A page says which charts it shows and gets nothing else: charts that no page shows cost nothing on the wire.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fullswarm.errors import did_you_mean
from fullswarm.operator.console import frames
from fullswarm.operator.console.fields import FIELDS
from fullswarm.operator.console.frames import Answer, Charted
from fullswarm.operator.console.samples import CHART_S, DEFAULT, Samples, Values
from fullswarm.operator.console.sessions import Listener
from fullswarm.operator.view import natural
from fullswarm.perf.metrics import METRICS, describe
from fullswarm.runtime import Scheduler

TITLES = dict(zip(DEFAULT, ("Work", "Coverage", "Collisions"), strict=True))
LINES = 8
"""Of so many robots each has a line; of more there are the least, the median and the largest value."""
BAND = ("least", "median", "largest")
AHEAD_S = 30.0
"""A chart of the past has samples beyond its moment, so that playing on needs no further frame for a while."""
WAIT_S, BUSY_SHARE = 0.05, 0.1
"""One page at a time gets whole charts, so long after the last one; making them takes at most this share of a core."""
MOST_CELLS = 250_000
"""Values that one whole chart is made of; of more samples only every second, third … is sent."""
DECIMALS = 4


@dataclass(frozen=True, slots=True)
class Lines:
    """What a chart consists of: its lines by name, the robots that they are made of, or why there is nothing."""

    names: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    band: bool = False
    why: str = field(default="", compare=False)


@dataclass(slots=True)
class _Shown:
    """The charts of a page.

    Attributes
    ----------
    sent_s : up to when the page has them; NaN before the whole was sent
    number : of the whole: rows continue that one only, as they may overtake the next
    """

    ref: int
    charts: tuple[Charted, ...]
    at_s: float | None
    sent_s: float = math.nan
    number: int = 0
    lines: list[Lines] = field(default_factory=list)


class ChartDesk:
    """Knows which page shows which charts, and sends them.

    Parameters
    ----------
    samples : what the charts are made of
    scheduler : of the pages
    """

    def __init__(self, samples: Samples, scheduler: Scheduler) -> None:
        self._samples, self._scheduler = samples, scheduler
        self._pages: dict[Listener, _Shown] = {}
        self._waiting: OrderedDict[Listener, None] = OrderedDict()  # for whole charts
        self._serving = False

    def handle(self, command: frames.Charts, listener: Listener) -> Answer:
        """Show a page these charts from now on. Of several frames the newest one counts."""
        if command.charts:
            self._pages[listener] = _Shown(command.ref, command.charts, command.at)
            self._wait(listener)
        else:
            self.leave(listener)
        return Answer(ref=command.ref)

    def leave(self, listener: Listener) -> None:
        """Forget a page."""
        self._pages.pop(listener, None)
        self._waiting.pop(listener, None)

    def close(self) -> None:
        """Send no more."""
        self._pages.clear()
        self._waiting.clear()

    def catalogue(self) -> dict[str, Any]:
        """Return the frame ``catalogue``: everything that can be charted, with title, unit and meaning."""
        names = [*DEFAULT, *sorted(name for name in self._samples.names if name not in TITLES)]
        return {
            "t": "catalogue",
            "fields": [
                {"name": name, "title": each.title, "unit": each.unit, "doc": each.doc, "scale": each.scale}
                for name, each in FIELDS.items()
            ],
            "metrics": [_metric(name) for name in names],
            "lines": LINES,
            "most": frames.MOST_CHARTS,
            "seconds": CHART_S,
        }

    def send_new(self) -> None:
        """Send all pages that show the present what was sampled since."""
        now_s = self._samples.to_s
        made: dict[tuple[Charted, float], dict[str, Any]] = {}
        for listener, shown in self._pages.items():
            if shown.at_s is not None or math.isnan(shown.sent_s) or now_s <= shown.sent_s:
                continue
            if shown.lines != [self._lines(each, now_s - CHART_S, now_s) for each in shown.charts]:
                shown.sent_s = math.nan
                self._wait(listener)
                continue
            charts = []
            for chart, lines in zip(shown.charts, shown.lines, strict=True):
                key = chart, shown.sent_s
                if key not in made:
                    made[key] = self._drawn(chart, lines, shown.sent_s, now_s)
                charts.append(made[key])
            shown.sent_s = now_s
            frame = {"t": "rows", "ref": shown.ref, "number": shown.number, "to": round(now_s, 3), "charts": charts}
            listener.put("rows", frames.encode(frame))

    # ---------------------------------------------------------------- whole charts
    def _wait(self, listener: Listener) -> None:
        self._waiting[listener] = None
        if not self._serving:
            self._serving = True
            self._scheduler.after(WAIT_S, self._serve)

    def _serve(self) -> None:
        self._serving = False
        if not self._waiting:
            return
        began_s = self._scheduler.now_s()
        listener, _ = self._waiting.popitem(last=False)
        self._send_whole(listener, self._pages[listener])
        took_s = self._scheduler.now_s() - began_s
        self._serving = True  # also if no page waits: the next one must not be served sooner
        self._scheduler.after(max(WAIT_S, took_s * (1.0 - BUSY_SHARE) / BUSY_SHARE), self._serve)

    def _send_whole(self, listener: Listener, shown: _Shown) -> None:
        newest_s = self._samples.to_s
        at_s = newest_s if shown.at_s is None else shown.at_s
        to_s = newest_s if shown.at_s is None else min(newest_s, at_s + AHEAD_S)
        shown.lines = [self._lines(each, at_s - CHART_S, to_s) for each in shown.charts]
        shown.sent_s, shown.number = to_s, shown.number + 1
        frame = {
            "t": "series",
            "ref": shown.ref,
            "number": shown.number,
            "at": shown.at_s,
            "to": round(to_s, 3) if math.isfinite(to_s) else None,
            "charts": [
                {
                    "lines": lines.names, "band": lines.band, "robots": len(lines.robots), "why": lines.why,
                    **self._drawn(chart, lines, at_s - CHART_S, to_s),
                }
                for chart, lines in zip(shown.charts, shown.lines, strict=True)
            ],
        }  # fmt: skip
        listener.put("series", frames.encode(frame))

    def _lines(self, chart: Charted, from_s: float, to_s: float) -> Lines:
        """Return what a chart consists of in a time."""
        if chart.of not in FIELDS:
            return self._quantity(chart)
        known = self._samples.robots(from_s, to_s)
        robots = chart.robots or tuple(sorted(known, key=natural))
        missing = [robot for robot in chart.robots if robot not in known]
        if not robots:
            return Lines(why="no robot has reported")
        if len(missing) == len(robots):
            return Lines(why=f"{_few(missing)} {'has' if len(missing) == 1 else 'have'} not reported")
        what = FIELDS[chart.of].title.lower()
        why = f"{_few(robots)} {'reports' if len(robots) == 1 else 'report'} no {what}"
        if not chart.robots:
            why = f"no robot reports {what}"
        band = len(robots) > LINES
        return Lines(BAND if band else robots, robots, band, why)

    def _quantity(self, chart: Charted) -> Lines:
        metric, _, quantity = chart.of.partition(".")
        known = chart.of in self._samples.names or describe(metric, quantity) is not None
        if not known:
            names = (*FIELDS, *DEFAULT, *self._samples.names)
            return Lines(why=f"there is no '{chart.of}', {did_you_mean(chart.of, names)}")
        if chart.robots:
            return Lines(why=f"{chart.of} is of the swarm, not of single robots")
        return Lines(("swarm",), why=f"the swarm reports no {chart.of} yet")

    def _drawn(self, chart: Charted, lines: Lines, from_s: float, to_s: float) -> dict[str, Any]:
        """Return times and values of a chart's lines."""
        if not lines.names:
            return {"times": [], "values": []}
        times = self._samples.times(from_s, to_s)
        if chart.of not in FIELDS:
            values = self._samples.of_swarm(chart.of, from_s, to_s)
        else:
            values = self._samples.of_robots(chart.of, lines.robots, from_s, to_s)
            step = math.ceil(values.size / MOST_CELLS) or 1
            times, values = times[::-step][::-1], values[:, ::-step][:, ::-1]
            if lines.band:
                values = band(values)
        return {"times": np.round(times, 3).tolist(), "values": np.round(values, DECIMALS).tolist()}


def band(values: Values) -> Values:
    """Return the least, the median and the largest of (robots, m) at each time, (3, m); NaN where none is known."""
    ordered = np.sort(np.where(np.isfinite(values), values, math.nan), axis=0)  # NaN come last
    counts = np.isfinite(ordered).sum(axis=0)
    places = np.maximum(counts, 1)  # of no values the first one, which is NaN
    column = np.arange(values.shape[1])
    low, high = ordered[(places - 1) // 2, column], ordered[places // 2, column]
    middle = np.where(counts % 2 == 1, low, 0.5 * (low + high))
    return np.stack([ordered[0], np.where(counts == 0, math.nan, middle), ordered[places - 1, column]])


def _metric(name: str) -> dict[str, Any]:
    metric, _, quantity = name.partition(".")
    found = describe(metric, quantity)
    unit, doc = ("", f"quantity {quantity} of the metric {metric}") if found is None else (found.unit, found.doc)
    title, scale = TITLES.get(name) or _title(metric, quantity), 100.0 if unit == "%" else 1.0
    return {"name": name, "title": title, "unit": unit, "doc": doc, "scale": scale}


def _title(metric: str, quantity: str) -> str:
    """Return a title for people: work, max_m → "Work, max"."""
    words = quantity.split("_")
    if metric in METRICS and len(words) > 1 and words[-1] in ("m", "s", "j", "m2"):
        words.pop()
    return f"{metric.replace('_', ' ').capitalize()}, {' '.join(words)}"


def _few(robots: Sequence[str]) -> str:
    """Return some names: "r1, r2, r3 and 5 others"."""
    shown = ", ".join(robots[:4])
    return shown if len(robots) <= 4 else f"{shown} and {len(robots) - 4} others"
