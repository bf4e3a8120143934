"""Figures as SVG text: small, the same bytes for the same data, fit to stand inside an HTML page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

from fullswarm.errors import MissingExtra

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito 2008: told apart by colour-blind readers too."""
MARKERS = ("o", "s", "^", "D", "v", "P")
INK, GRID, SOLID, PAPER = "#1f2328", "#d0d4d9", "#9aa1a9", "#fefefe"
"""Text and lines, grid, obstacles, background."""
THEME = {INK: "var(--ink, #1f2328)", GRID: "var(--grid, #d0d4d9)", SOLID: "var(--solid, #9aa1a9)"}
"""What follows the page's light or dark theme."""

STYLE: dict[Any, Any] = {  # keys are literals in Matplotlib's types
    "svg.fonttype": "none",  # text stays text: small, sharp, can be searched
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "path.simplify": True,
    "path.simplify_threshold": 0.5,
    "image.composite_image": False,
}


@contextmanager
def style(name: str) -> Iterator[None]:
    """Draw in the report's style; `name` keeps the ids of two figures on a page apart.

    Raises
    ------
    MissingExtra
        Matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise MissingExtra("plots need Matplotlib", hint="pip install 'fullswarm[experiments]'") from error
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        yield


Sharing = Literal["none", "all", "row", "col"]


def panels(
    rows: int, columns: int, width: float, height: float, sharex: Sharing = "none", sharey: Sharing = "none"
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels, each `width` x `height` inches, and the panels row by row."""
    from matplotlib.figure import Figure

    # Not pyplot: it keeps figures alive and looks for a screen.
    figure = Figure(figsize=(columns * width, rows * height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
    return figure, list(axes.ravel())


def legend_below(figure: Figure, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """Put one legend for all panels under them."""
    figure.legend(handles, labels, loc="outside lower center", markerscale=1.4, ncols=min(4, max(1, len(labels))))


def to_svg(figure: Figure, name: str, description: str) -> str:
    """Return a figure as an SVG document with a white background; call within `style`."""
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None}, facecolor=PAPER)
    return _tidied(file.getvalue(), name, description)


def inline(svg: str) -> str:
    """Return an SVG document for the inside of an HTML page, in the colours of the page's theme."""
    body = svg[svg.index("<svg") :]
    body = re.sub(r' (xmlns(:xlink)?|version)="[^"]*"', "", body, count=3)
    body = body.replace("xlink:href", "href").replace(f"fill: {PAPER}", "fill: none")
    for colour, variable in THEME.items():
        body = body.replace(colour, variable)
    return body


def _tidied(svg: str, name: str, description: str) -> str:
    """Drop what a page does not need, and digits that no eye can see."""
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<\?xml.*?\?>|<!DOCTYPE.*?>", "", svg, flags=re.DOTALL).strip()
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg))
    svg = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", svg)
    svg = re.sub(r' transform="rotate\(-0 [^"]*"', "", svg)
    svg = svg.replace("fill-opacity: 0;", "fill: none;")  # what simple viewers understand too
    svg = svg.replace("font-family: 'DejaVu Sans'", "font-family: 'DejaVu Sans', Verdana, sans-serif")
    svg = re.sub(r' (?:d|x|y|width|height)="[^"]*"', lambda found: _rounded(found[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg).replace(" \n", "\n")
    title = description.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    head, _, rest = svg.partition(">")
    return f'{head} role="img" aria-labelledby="{name}-title">\n<title id="{name}-title">{title}</title>{rest}\n'


def _rounded(text: str) -> str:
    return re.sub(r"-?\d+\.\d+", lambda found: f"{float(found[0]):.2f}".rstrip("0").rstrip("."), text)
