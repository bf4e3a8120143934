"""The report of a results folder: one HTML file that needs nothing else, and plots for documentation."""

from __future__ import annotations

import os
import re
import shlex
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.evaluate.results.export import wide, write_table
from fullswarm.evaluate.results.folder import Asked, Folder, StoredTrial, read_folder
from fullswarm.evaluate.results.index import INDEX_FILE, rebuild
from fullswarm.evaluate.results.maps import coverage_plot, trajectories_plot
from fullswarm.evaluate.results.plots import Plot, collisions_plot, means_plot
from fullswarm.evaluate.results.sample import Condition, conditions
from fullswarm.evaluate.results.svg import inline
from fullswarm.evaluate.results.tables import Grid, agreement_grid, cells_grid, filter_grid, trials_grid, trouble_grid

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


def write_report(out: Path) -> Path:
    """Write ``report.html``, ``results.csv`` and the index into a results folder; return the report.

    The same directories give the same bytes.

    Raises
    ------
    ConfigError
        The folder holds no trials, or it cannot be written.
    MissingExtra
        Jinja2, Matplotlib or SciPy is not installed.
    """
    folder = rebuild(out)
    write_table(wide(folder.trials), out / CSV_FILE, "csv")
    text = render(folder)
    path = out / REPORT_FILE
    _replace(path, text)
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
    written = []
    for section in sections:
        for plot in filter(None, (section.collisions, section.means, *section.arenas)):
            written.append(folder / f"{plot.name}.svg")
            _replace(written[-1], plot.svg)
    written.append(folder / TABLE_FILE)
    _replace(written[-1], "\n".join(_markdown(each) for each in sections))
    return written


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
    page.filters["picture"] = lambda plot: Markup(inline(plot.svg))  # noqa: S704  (our own SVG; its texts are escaped)
    sections = _sections(folder.trials)
    names = sorted({each.record.experiment for each in folder.trials})
    return page.from_string(source).render(
        title=", ".join(names) or "no readable trial",
        figures=_figures(folder),
        facts=_facts(folder.trials, folder.asked),
        commands=_commands(folder, names),
        sections=sections,
        trouble=trouble_grid(folder),
        trials=trials_grid(folder.trials),
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
        ("fullswarm", _counted(" ".join(filter(None, (how.fullswarm, how.git))) for how in hows)),
        ("Python", _counted(how.python for how in hows)),
        ("Packages", ", ".join(sorted(packages))),
        ("Host", _counted(" · ".join(filter(None, (how.host, how.machine))) for how in hows)),
        ("Runner", _counted(how.runner for how in hows)),
        ("Started", " to ".join(dict.fromkeys((started[0], started[-1]))) if started else ""),
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


def _replace(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        part.write_text(text, "utf-8")
        part.replace(path)
    except OSError as error:
        raise ConfigError(f"cannot write: {error.strerror or error}", where=str(path)) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
