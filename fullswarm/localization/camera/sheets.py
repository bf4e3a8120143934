"""Prints the sheets: tags for robots and for the floor, and the calibration board, at true size (PDF, vector)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.localization.camera.board import COLUMNS, ROWS, SQUARE_M, board_picture
from fullswarm.localization.camera.finder import CELLS, FAMILY, pattern
from fullswarm.localization.camera.optics import INSTALL, opencv
from fullswarm.localization.camera.plan import TagPlan

PAPERS_M = {"a4": (0.210, 0.297), "letter": (0.2159, 0.2794)}
MARGIN_M = 0.012
GAP_M = 0.014
TITLE_M = 0.012
RULER_M = 0.1
INCH_M = 0.0254
POINT_M = INCH_M / 72.0
BOARD_PIXELS = 160


@dataclass(frozen=True, slots=True)
class Card:
    """One tag to cut out."""

    tag: int
    title: str
    size_m: float

    @property
    def outer_m(self) -> float:
        """Side with the white edge of one cell, where it is cut."""
        return self.size_m * (CELLS + 2) / CELLS


def cards_of(plan: TagPlan, *, placed: bool = True) -> list[Card]:
    """Return what is printed for a plan; `placed`: with the places of the floor tags."""
    robots = [Card(each.tag, f"robot {each.robot}", each.size_m) for each in plan.robots.values()]
    floor = [
        Card(each.tag, f"floor, at x = {each.x_m:g} m, y = {each.y_m:g} m" if placed else "floor", each.size_m)
        for each in plan.floor.values()
    ]
    return robots + floor


def write_sheets(plan: TagPlan, out: Path, paper: str = "a4", *, with_board: bool = True, placed: bool = True) -> int:
    """Write the sheets; return the number of pages.

    Raises
    ------
    ConfigError
        A tag is larger than the paper, or the file cannot be written.
    MissingExtra
        matplotlib or OpenCV is not installed.
    """
    try:
        from matplotlib.backends.backend_pdf import FigureCanvasPdf, PdfPages
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("sheets need matplotlib", hint=INSTALL) from error
    cv2 = opencv()
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY))
    width_m, height_m = PAPERS_M[paper]
    pages = list(_pages(cards_of(plan, placed=placed), width_m, height_m, paper))
    count = len(pages) + int(with_board)
    try:
        with PdfPages(out, metadata={"Title": "Tags for fullswarm track", "CreationDate": None}) as pdf:
            for number, page in enumerate(pages, 1):
                sheet = _Sheet(Figure, FigureCanvasPdf, width_m, height_m)
                sheet.foot(number, count)
                for card, x_m, y_m in page:
                    sheet.tag(card, x_m, y_m, pattern(cv2, dictionary, card.tag))
                pdf.savefig(sheet.figure)
            if with_board:
                sheet = _Sheet(Figure, FigureCanvasPdf, height_m, width_m)
                sheet.foot(count, count)
                sheet.board()
                pdf.savefig(sheet.figure)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(out)) from error
    return count


def _pages(cards: list[Card], width_m: float, height_m: float, paper: str) -> Iterator[list[tuple[Card, float, float]]]:
    """Yield the cards of each page with their lower left corners, filled row by row from the top."""
    page: list[tuple[Card, float, float]] = []
    top = height_m - MARGIN_M
    x_m, row_m = MARGIN_M, 0.0
    for card in cards:
        wide, high = card.outer_m, card.outer_m + TITLE_M
        if wide > width_m - 2 * MARGIN_M or high > height_m - 2 * MARGIN_M - RULER_M / 4.0:
            hint = f"[tags] size_m or floor_size_m, up to {0.8 * (width_m - 2 * MARGIN_M):.3f}; or print it elsewhere"
            raise ConfigError(f"tag {card.tag} of {card.size_m:g} m does not fit on {paper}", hint=hint)
        if x_m + wide > width_m - MARGIN_M + 1e-9:
            x_m, top, row_m = MARGIN_M, top - row_m - GAP_M, 0.0
        if top - high < MARGIN_M + RULER_M / 4.0:
            yield page
            page, x_m, top, row_m = [], MARGIN_M, height_m - MARGIN_M, 0.0
        page.append((card, x_m, top - high))
        x_m, row_m = x_m + wide + GAP_M, max(row_m, high)
    if page:
        yield page


class _Sheet:
    """A page whose units are metres from its lower left corner."""

    def __init__(self, figure: Any, canvas: Any, width_m: float, height_m: float) -> None:
        self.figure = figure(figsize=(width_m / INCH_M, height_m / INCH_M))
        canvas(self.figure)
        self._axes = self.figure.add_axes((0, 0, 1, 1))
        self._axes.set_xlim(0, width_m)
        self._axes.set_ylim(0, height_m)
        self._axes.axis("off")
        self._width_m, self._height_m = width_m, height_m

    def _text(self, x_m: float, y_m: float, words: str, size_m: float = 0.0035, **more: Any) -> None:
        self._axes.text(x_m, y_m, words, fontsize=size_m / POINT_M, **more)

    def _image(self, grey: Any, left_m: float, right_m: float, low_m: float, high_m: float) -> None:
        self._axes.imshow(
            grey, cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto",
            extent=(left_m, right_m, low_m, high_m),
        )  # fmt: skip
        self._axes.set_xlim(0, self._width_m)  # which `imshow` has changed
        self._axes.set_ylim(0, self._height_m)

    def _line(self, *points: tuple[float, float], width_m: float = 0.0003, colour: str = "black") -> None:
        x, y = zip(*points, strict=True)
        self._axes.plot(x, y, color=colour, linewidth=width_m / POINT_M, solid_capstyle="butt")

    def foot(self, number: int, count: int) -> None:
        """Draw the ruler and what to do with it."""
        x_m, y_m = MARGIN_M, MARGIN_M
        self._line((x_m, y_m), (x_m + RULER_M, y_m))
        for step in range(11):
            self._line((x_m + step * RULER_M / 10, y_m), (x_m + step * RULER_M / 10, y_m + 0.003))
        words = f'must be 100 mm: print at 100 %, not "fit to page"     page {number} of {count}, fullswarm track'
        self._text(x_m + RULER_M + 0.003, y_m, words, 0.0026)

    def tag(self, card: Card, x_m: float, y_m: float, white: Any) -> None:
        """Draw a tag with its edge, its name and an arrow to what is ahead."""
        outer, cell = card.outer_m, card.size_m / CELLS
        frame = ((x_m, y_m), (x_m + outer, y_m), (x_m + outer, y_m + outer), (x_m, y_m + outer), (x_m, y_m))
        self._line(*frame, width_m=0.0001, colour="0.6")
        low_m, high_m = cell, card.size_m + cell
        self._image(255 * white.astype("uint8"), x_m + low_m, x_m + high_m, y_m + low_m, y_m + high_m)
        middle = x_m + outer / 2.0
        self._axes.annotate(
            "", (middle, y_m + outer + 0.0075), (middle, y_m + outer + 0.0005),
            arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 0.8},
        )  # fmt: skip
        self._text(middle + 0.003, y_m + outer + 0.0035, "ahead", 0.0028)
        title = f"tag {card.tag}: {card.title}"
        self._text(x_m, y_m + outer + 0.0085, f"{title}, black square {1000 * card.size_m:g} mm", 0.0028)

    def board(self) -> None:
        """Draw the calibration board."""
        width, height = COLUMNS * SQUARE_M, ROWS * SQUARE_M
        left, low = (self._width_m - width) / 2.0, (self._height_m - height) / 2.0 + 0.002
        self._image(board_picture(BOARD_PIXELS), left, left + width, low, low + height)
        words = f"calibration board, squares of {1000 * SQUARE_M:g} mm: glue it on something flat and stiff"
        self._text(left, low + height + 0.002, words, 0.0035)
