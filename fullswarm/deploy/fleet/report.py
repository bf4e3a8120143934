"""The result of a command, robot by robot: what happened, and what to do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

from rich.markup import escape
from rich.table import Table

from fullswarm import output
from fullswarm.deploy.fleet.rollout import GOOD, Stage
from fullswarm.deploy.fleet.work import Outcome

MANY = 110
"""Columns into a file: a reason that is broken in five is hard to find again."""


@dataclass(frozen=True, slots=True)
class Row:
    """One robot's line; `exit_code` 0 when all is well with it."""

    robot: str
    result: str
    what: str = ""
    mend: str = ""
    release: str = ""
    shipped_bytes: int = 0
    exit_code: int = 0

    @classmethod
    def of(cls, robot: str, outcome: Outcome) -> Row:
        """From what a rollout says."""
        code = 0 if outcome.stage in GOOD else outcome.exit_code
        changed = f" ({', '.join(outcome.changed)})" if outcome.changed and code == 0 else ""
        return cls(
            robot,
            str(outcome.stage),
            outcome.what if outcome.stage is Stage.CURRENT else outcome.what + changed,
            outcome.mend,
            outcome.release,
            outcome.shipped_bytes,
            code,
        )


def tell(rows: Sequence[Row], *, as_json: bool) -> int:
    """Print the rows and return the exit code: 0, 1 when some failed, else what all of them failed with."""
    codes = {each.exit_code for each in rows}
    code = codes.pop() if len(codes) == 1 else 1
    if as_json:
        robots = [{**asdict(each), "ok": not each.exit_code} for each in rows]
        for robot in robots:
            del robot["exit_code"]
        output.data_json({"ok": code == 0, "robots": robots})
        return code
    columns = ("robot", "result", "runs", "shipped", "what", "what to do")
    cells = [
        (each.robot, each.result, each.release or "-", size(each.shipped_bytes), each.what, each.mend) for each in rows
    ]
    output.data_table(table(columns, cells), into_file=MANY)
    return code


def table(columns: Iterable[str], rows: Iterable[Sequence[str]]) -> Table:
    """A plain table, whose words are only words: no markup that a robot could have put there."""
    shown = Table(box=None, pad_edge=False)
    for name in columns:
        shown.add_column(name, overflow="fold", no_wrap=name in ("robot", "result"))
    for row in rows:
        shown.add_row(*(escape(each) for each in row))
    return shown


def size(count: int) -> str:
    """``0.3 MB``."""
    if count < 1000:
        return f"{count} B" if count else "-"
    return f"{count / 1000:.0f} kB" if count < 1_000_000 else f"{count / 1e6:.1f} MB"
