"""Writes the report of a results folder: one HTML file that needs nothing else, and its plots and tables as files."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.evaluate.experiment.plan import differ_by_group
from fullswarm.evaluate.results.cards import card_of, clock_text, tooltip
from fullswarm.evaluate.results.export import wide, write_table
from fullswarm.evaluate.results.figures import (
    Plot,
    anchor,
    collisions_plot,
    coverage_plot,
    effect_plot,
    inline,
    link_to,
    means_plot,
    trajectories_plot,
    unlinked,
)
from fullswarm.evaluate.results.folder import Asked, Folder, StoredTrial, read_folder
from fullswarm.evaluate.results.headline import headline
from fullswarm.evaluate.results.index import INDEX_FILE, rebuild
from fullswarm.evaluate.results.quantities import (
    ARRIVED,
    COLLISIONS,
    COVERAGE,
    PAIRS,
    QUIET,
    REVERSALS,
    SETTLED,
    SPEED_VARIATION,
    TIME,
    TOUCHED,
    TURN_VARIATION,
    WORK,
    Quantity,
)
from fullswarm.evaluate.results.sample import Condition, Sample, bare, conditions, is_filtered
from fullswarm.evaluate.results.statistics import Paired, describe, holm, paired, wilson
from fullswarm.evaluate.trial_folder import RESULT_FILE, TRIAL_FILE, TRIALS, whole_file
from fullswarm.units import unit_of

REPORT_FILE, CSV_FILE, TABLE_FILE = "report.html", "results.csv", "table.md"
TEMPLATE = "report.html.j2"
MOST_ARENAS = 24
"""Pictures of arenas in one report: with all of them that of many conditions would be too large to open."""


@dataclass(frozen=True, slots=True)
class Section:
    """What the report shows of one condition."""

    name: str
    collisions: Plot | None  # None: no trial has figures
    means: Plot | None
    arenas: list[Plot]
    cells: Grid
    filtered: Grid | None
    agreement: Grid | None


STEPS = 3
"""Reading all trials, writing the table, drawing."""


def write_report(out: Path, tell: Callable[[int, int], None] = lambda _done, _of: None) -> Path:
    """Write ``report.html``, ``results.csv`` and the index into a results folder; return the report.

    The same directories give the same bytes. `tell` is called with how many steps of how many are done.

    Raises
    ------
    ConfigError
        The folder holds no trials, or it cannot be written.
    MissingExtra
        Jinja2, Matplotlib or SciPy is not installed.
    """
    folder = rebuild(out)
    tell(1, STEPS)
    write_table(wide(folder.trials), out / CSV_FILE, "csv")
    tell(2, STEPS)
    text = render(folder)
    tell(3, STEPS)
    path = out / REPORT_FILE
    with whole_file(path) as part:
        part.write_text(text, "utf-8")
    return path


def write_plots(out: Path, folder: Path) -> list[Path]:
    """Write the plots of the results in `out` as SVG files and the tables as Markdown into `folder`.

    Raises
    ------
    ConfigError
        There are no trials, or `folder` cannot be written.
    MissingExtra
        Matplotlib or SciPy is not installed.
    """
    read = read_folder(out)
    sections = _sections(read.trials)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot make the folder: {error.strerror or error}", where=str(folder)) from error
    found = headline(read.trials)
    plots = [effect_plot(found, "effect")] if found else []
    plots += [plot for each in sections for plot in (each.collisions, each.means, *each.arenas) if plot]
    texts = {folder / f"{plot.name}.svg": unlinked(plot.svg) for plot in plots}
    texts[folder / TABLE_FILE] = "\n".join([*([f"{found.sentence}\n"] if found else []), *map(_markdown, sections)])
    for path, text in texts.items():
        with whole_file(path) as part:
            part.write_text(text, "utf-8")
    return list(texts)


def render(folder: Folder) -> str:
    """Return the report as HTML.

    Raises
    ------
    MissingExtra
        Jinja2, Matplotlib or SciPy is not installed.
    """
    try:
        from jinja2 import Environment, StrictUndefined
        from markupsafe import Markup
    except ImportError as error:
        raise MissingExtra("the report needs Jinja2", hint="pip install 'fullswarm[experiments]'") from error
    source = resources.files(__package__).joinpath(TEMPLATE).read_text("utf-8")
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    tips = {anchor(each): tooltip(each) for each in folder.trials}
    page.filters["picture"] = lambda plot: Markup(inline(plot.svg, tips))  # noqa: S704  (our own SVG; texts are escaped)
    found = headline(folder.trials)
    sections = _sections(folder.trials)
    names = sorted({each.record.experiment for each in folder.trials})
    return page.from_string(source).render(
        title=", ".join(names) or "no readable trial",
        headline=found,
        effect=effect_plot(found, "effect") if found else None,
        compare=f"fullswarm results compare {shlex.quote(folder.path.name or '.')} A B --by behaviour",
        figures=_figures(folder),
        facts=_facts(folder.trials, folder.asked),
        commands=_commands(folder, names),
        sections=sections,
        trouble=trouble_grid(folder),
        trials=trials_grid(folder.trials),
        cards=[card_of(each, folder.path) for each in folder.trials],
        arenas_left_out=sum(len(each.arenas) for each in sections) >= MOST_ARENAS,
        csv=CSV_FILE,
        index=INDEX_FILE,
    )


def _sections(trials: list[StoredTrial]) -> list[Section]:
    sections: list[Section] = []
    left = MOST_ARENAS
    for place, condition in enumerate(conditions(trials)):
        sections.append(_section(condition, f"-{place + 1}" if place else "", left))
        left -= len(sections[-1].arenas)
    return sections


def _section(condition: Condition, end: str, most_arenas: int) -> Section:
    arenas: list[Plot] = []
    for scenario in condition.scenarios:
        word = re.sub(r"[^A-Za-z0-9]+", "-", Path(scenario).stem)
        for draw, name in ((trajectories_plot, "trajectories"), (coverage_plot, "coverage")):
            plot = draw(condition, scenario, f"{name}-{word}{end}") if len(arenas) < most_arenas else None
            arenas += [plot] if plot else []
    return Section(
        name=condition.name,
        collisions=collisions_plot(condition, f"collisions{end}"),
        means=means_plot(condition, f"means{end}"),
        arenas=arenas,
        cells=cells_grid(condition),
        filtered=filter_grid(condition),
        agreement=agreement_grid(condition),
    )


def _figures(folder: Folder) -> list[tuple[str, str, str]]:
    """Return the summary's numbers: value, what it is, tone."""
    outcomes = [each.record.outcome for each in folder.trials if each.record.outcome]
    failed, simulated_s = len(folder.failed), sum(each.simulated_s for each in outcomes)
    wall_s = sum(each.provenance.wall_s for each in folder.trials)
    apart = sum(not each.safe_start for each in outcomes)
    figures = [
        (str(len(outcomes)), "trials done", ""),
        (str(failed), "trials failed", "bad" if failed else "good"),
        (f"{simulated_s:,.0f} s", "simulated", ""),
        (f"{wall_s:,.0f} s", "of worker time", ""),
    ]
    if wall_s > 0.0:
        figures.append((f"{simulated_s / wall_s:.1f} ×", "real time, per worker", ""))
    if folder.problems:
        figures.append((str(len(folder.problems)), "unreadable files", "bad"))
    if folder.missing:
        figures.append((str(len(folder.missing)), "trials missing", "bad"))
    if folder.older:
        figures.append((str(folder.older), "trials of older settings: in no other figure", "bad"))
    if apart:
        figures.append((str(apart), "began outside the safe set: in no other figure", "bad"))
    return figures


def _facts(trials: list[StoredTrial], asked: Asked) -> list[tuple[str, str]]:
    """Return what was run, where and with what."""
    hows = [each.provenance for each in trials]
    cells = [each.record.trial.cell for each in trials]
    started = sorted(each.started for each in hows if each.started)
    packages = {f"{name} {version}" for how in hows for name, version in how.packages.items()}
    facts = [
        ("Experiment", asked.description),
        ("Behaviours", _list(cell.label for cell in cells)),
        ("Scenarios", _list(cell.scenario for cell in cells)),
        ("Robots", ", ".join(map(str, sorted({cell.robots for cell in cells})))),
        ("Seeds", _ranges(each.record.trial.seed for each in trials)),
        ("Engines and limits", _list(f"{cell.engine}, {cell.limits}" for cell in cells)),
        ("Networks", _list(cell.network for cell in cells)),
        ("How trials ended", _counted(each.record.end_reason for each in trials)),
        ("fullswarm", _counted(" ".join(filter(None, (how.fullswarm, how.git[:12]))) for how in hows)),
        ("Python", _counted(how.python for how in hows)),
        ("Packages", ", ".join(sorted(packages))),
        ("Host", _counted(" · ".join(filter(None, (how.host, how.machine))) for how in hows)),
        ("Runner", _counted(how.runner for how in hows)),
        ("Started", " to ".join(dict.fromkeys(map(clock_text, (started[0], started[-1])))) if started else ""),
    ]
    return [(name, text) for name, text in facts if text]


def _commands(folder: Folder, names: list[str]) -> list[tuple[str, str]]:
    """Return commands for the reader, with what each does."""
    where = shlex.quote(folder.path.name or ".")
    commands = []
    for name in names:
        asked = folder.asked if folder.asked.name == name else Asked()
        commands.append((f"{shlex.join(_run_words(name, asked))} --out {where}", "run what is missing"))
    if folder.trials:
        path = f"{where}/trials/{folder.trials[0].record.id}/trial.toml"
        commands.append((f"fullswarm experiment trial {path}", "run one trial again, alone"))
    commands.append((f"fullswarm results list {where}", "the cells in the terminal"))
    commands.append((f"fullswarm results export {where} --format parquet", "for other programs"))
    commands.append((f"fullswarm results report {where}", "make this page again"))
    return commands


def _run_words(name: str, asked: Asked) -> list[str]:
    """Return the command that asked for the trials, without its folder."""
    words = ["fullswarm", "experiment", "run", asked.file or name, *["--small"] * asked.small]
    words += [word for each in asked.cells for word in ("--cells", each)]
    how, _, make = asked.how.partition(" ")
    words += ["--live"] * (how == "live")
    options = {
        "--seeds": asked.seeds or None,
        "--engine": asked.engine or None,
        "--network": asked.network,  # empty: a good one, whatever the file says
        "--emulate": make or None,
        "--fleet": asked.fleet,
    }
    return words + [word for option, value in options.items() if value is not None for word in (option, value)]


def _list(names: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(name for name in names if name))


def _counted(names: Iterable[str]) -> str:
    """Return the values; with more than one, how often each occurs."""
    counts = Counter(name for name in names if name)
    return ", ".join(f"{name} ({count})" if len(counts) > 1 else name for name, count in counts.most_common())


def _ranges(numbers: Iterable[int]) -> str:
    """Return ``0-19, 25``."""
    ranges: list[list[int]] = []
    for number in sorted(set(numbers)):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)


def _markdown(section: Section) -> str:
    parts = [
        f"## {section.name[:1].upper()}{section.name[1:]}\n",
        "Mean [95 % confidence interval].\n",
        section.cells.markdown(),
    ]
    if section.filtered:
        parts += ["### Collisions per trial without and with the filter, paired by seed\n", section.filtered.markdown()]
    return "\n".join(parts)


NONE = "–"


@dataclass(frozen=True, slots=True)
class Entry:
    """A field of a table; `tone` is "bad" or "good" where it has one."""

    text: str
    href: str = ""
    tone: str = ""


@dataclass(frozen=True, slots=True)
class Grid:
    """A table; its first `words` columns are text, the others figures."""

    headers: list[str]
    rows: list[list[Entry]]
    words: int = 1

    def markdown(self) -> str:
        """Return the table as Markdown, without links."""
        rule = ["---" if place < self.words else "---:" for place in range(len(self.headers))]
        lines = [self.headers, rule, *([entry.text.replace("|", "\\|") for entry in row] for row in self.rows)]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)


MEANS = (TIME, WORK, COVERAGE, SETTLED, QUIET, REVERSALS, SPEED_VARIATION, TURN_VARIATION)
"""The last columns of the cells' table."""


def cells_grid(condition: Condition) -> Grid:
    """Return all cells with means, quartiles and 95 % confidence intervals."""
    headers = ["Scenario", "Behaviour", "Robots", "Trials", "Collisions per trial", "Median (quartiles)"]
    headers += [
        PAIRS.label,
        TOUCHED.label,
        "Trials with collisions [%]",
        "Robots that arrived [%]",
        "Trials in which all arrived [%]",
    ]
    headers += [each.label for each in MEANS]
    return Grid(headers, [_cell_row(each) for each in condition.samples], words=2)


def _cell_row(sample: Sample) -> list[Entry]:
    cell, events, count = sample.cell, sample.of(COLLISIONS), len(sample.counted)
    struck = sum(each > 0 for each in events)
    described = describe(events)
    quartiles = f"{described.median:g} ({described.lower_quartile:g} to {described.upper_quartile:g})"
    all_arrived = sum(each[("outcome", "all_arrived")] > 0 for each in sample.values)
    notes = [f"{sample.failed} failed"] * bool(sample.failed) + [f"{sample.apart} apart"] * bool(sample.apart)
    return [
        Entry(cell.scenario),
        Entry(cell.label),
        Entry(str(cell.robots)),
        Entry(f"{count}{' (' + ', '.join(notes) + ')' if notes else ''}", tone="bad" if sample.failed else ""),
        Entry(
            _mean(sample, COLLISIONS),
            tone="" if not count or (struck and cell.collisions_expected) else "bad" if struck else "good",
        ),
        Entry(quartiles if count else NONE),
        Entry(_mean(sample, PAIRS)),
        Entry(_mean(sample, TOUCHED)),
        Entry(_share(struck, count)),
        Entry(_mean(sample, ARRIVED)),
        Entry(_share(all_arrived, count)),
        *(Entry(_mean(sample, each)) for each in MEANS),
    ]


def filter_grid(condition: Condition) -> Grid | None:
    """Return each behaviour with and without the safety filter, paired by seed; None when there is no such pair."""
    headers = ["Scenario", "Behaviour", "Robots", "Pairs", "Without filter", "With filter", "Difference"]
    headers += ["Fewer / equal / more", "Rank-biserial", "Cohen's dz", "p (sign)", "p (signed-rank)", "p (Holm)"]
    found: list[tuple[Sample, Paired]] = []
    for sample in condition.samples:
        cell = sample.cell
        if not is_filtered(cell.label):
            continue
        other = condition.sample(cell.scenario, bare(cell.label), cell.robots)
        if other is not None and (result := _filter_pairs(other, sample)):
            found.append((sample, result))
    corrected = holm([result.wilcoxon_p for _, result in found])
    rows = [_filter_row(sample, result, p) for (sample, result), p in zip(found, corrected, strict=True)]
    return Grid(headers, rows, words=2) if rows else None


def _filter_pairs(without: Sample, behind: Sample) -> Paired | None:
    first, second = (
        dict(zip((each.record.trial.seed for each in sample.counted), sample.of(COLLISIONS), strict=True))
        for sample in (without, behind)
    )
    seeds = [seed for seed in first if seed in second]
    return paired([first[seed] for seed in seeds], [second[seed] for seed in seeds]) if seeds else None


def _filter_row(behind: Sample, result: Paired, corrected_p: float) -> list[Entry]:
    cell = behind.cell
    tone = "good" if result.mean_b <= result.mean_a else "bad"
    return [
        Entry(cell.scenario),
        Entry(bare(cell.label)),
        Entry(str(cell.robots)),
        Entry(str(result.count)),
        Entry(f"{result.mean_a:.2f}"),
        Entry(f"{result.mean_b:.2f}", tone=tone),
        Entry(interval(result.mean_difference, result.low, result.high, 2)),
        Entry(f"{result.less} / {result.equal} / {result.more}"),
        Entry(f"{result.rank_biserial:+.2f}"),
        Entry(NONE if result.dz is None else f"{result.dz:+.2f}"),
        Entry(p_text(result.sign_p)),
        Entry(p_text(result.wilcoxon_p)),
        Entry(p_text(corrected_p)),
    ]


def agreement_grid(condition: Condition) -> Grid | None:
    """Return what the robots measured of themselves beside the truth; None when no value has both."""
    values = [each for sample in condition.samples for each in sample.values]
    names = sorted(
        {name for each in values for source, name in each if source == "truth" and ("onboard", name) in each}
    )
    rows = []
    for name in names:
        both = [
            (each[("truth", name)], each[("onboard", name)])
            for each in values
            if {("truth", name), ("onboard", name)} <= each.keys()
        ]
        result = paired([true for true, _ in both], [onboard for _, onboard in both])
        largest = max(abs(onboard - true) for true, onboard in both)
        rows.append(
            [
                Entry(name),
                Entry(unit_of(name)),
                Entry(str(result.count)),
                Entry(f"{result.mean_a:.4g}"),
                Entry(f"{result.mean_b:.4g}"),
                Entry(interval(result.mean_difference, result.low, result.high, 4)),
                Entry(f"{largest:.4g}"),
            ]
        )
    headers = ["Quantity", "Unit", "Trials", "True mean", "On-board mean", "On-board − true", "Largest difference"]
    return Grid(headers, rows, words=2) if rows else None


def trials_grid(trials: list[StoredTrial]) -> Grid:
    """Return every trial with links to its files."""
    headers = ["Scenario", "Behaviour", "Engine, limits", "End", "Files", "", "Robots", "Seed", "Collisions"]
    headers += ["Arrived", "Simulated [s]", "Wall [s]"]
    rows = [_trial_row(each) for each in trials]
    if not differ_by_group(each.record.trial.cell for each in trials):
        return Grid(headers, rows, words=6)
    groups = [Entry(each.record.trial.cell.group) for each in trials]
    return Grid(["Group", *headers], [[group, *row] for group, row in zip(groups, rows, strict=True)], words=7)


def _trial_row(stored: StoredTrial) -> list[Entry]:
    record, folder = stored.record, _link(stored)
    cell, outcome = record.trial.cell, record.outcome
    return [
        Entry(cell.scenario),
        Entry(cell.label, link_to(stored)),
        Entry(f"{cell.engine}, {cell.limits}"),
        Entry(record.end_reason or ("failed" if outcome is None else NONE), tone="bad" if outcome is None else ""),
        Entry("result", f"{folder}{RESULT_FILE}"),
        Entry("launch file", f"{folder}{TRIAL_FILE}"),
        Entry(str(cell.robots)),
        Entry(str(record.trial.seed)),
        Entry(str(outcome.events) if outcome else NONE),
        Entry(f"{outcome.arrived}/{outcome.robots}" if outcome else NONE),
        Entry(f"{outcome.simulated_s:.1f}" if outcome else NONE),
        Entry(f"{stored.provenance.wall_s:.1f}"),
    ]


def trouble_grid(folder: Folder) -> Grid | None:
    """Return missing, failed, retried and unreadable trials with reason and folder; None when there are none."""
    rows = [
        [Entry(name), Entry("missing", tone="bad"), Entry("asked for, not run yet"), Entry(NONE)]
        for name in folder.missing
    ]
    for stored in folder.trials:
        attempts = stored.provenance.attempts
        if stored.record.outcome is None:
            what, tone = f"failed after {attempts} attempts" if attempts > 1 else "failed", "bad"
        elif attempts > 1:
            what, tone = f"done at attempt {attempts}", ""
        else:
            continue
        reason = stored.record.failure or NONE
        rows.append(
            [Entry(stored.record.trial.label), Entry(what, tone=tone), Entry(reason), Entry("folder", _link(stored))]
        )
    for problem in folder.problems:
        href = quote(str(problem.path.relative_to(folder.path)))
        rows.append(
            [Entry(problem.path.name), Entry("unreadable", tone="bad"), Entry(problem.reason), Entry("folder", href)]
        )
    return Grid(["Trial", "What", "Reason", "Files"], rows, words=4) if rows else None


def _link(stored: StoredTrial) -> str:
    return f"{TRIALS}/{quote(stored.path.name)}/"


def _mean(sample: Sample, quantity: Quantity) -> str:
    result = describe(sample.of(quantity), at_least=0.0)
    return interval(
        result.mean, result.low, min(result.high, 100.0) if quantity.unit == "%" else result.high, quantity.decimals
    )


def _share(count: int, total: int) -> str:
    if not total:
        return NONE
    low, high = wilson(count, total)
    return interval(100.0 * count / total, 100.0 * low, 100.0 * high, 0)


def interval(value: float, low: float, high: float, decimals: int) -> str:
    """Return ``value [low, high]``; an unknown interval is left out."""
    if math.isnan(value):
        return NONE
    text = f"{value:.{decimals}f}"
    return text if math.isnan(low) else f"{text} [{low:.{decimals}f}, {high:.{decimals}f}]"


def p_text(p: float) -> str:
    """Return a p for people."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
