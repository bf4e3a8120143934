"""Write the texts of the published results from what ``fullswarm experiment run … --json`` has printed.

Each command, one after the other::

    fullswarm experiment run safety --out results/safety --json > safety.json
    python docs/results/write.py safety safety.json

    fullswarm experiment run paper --out results/paper --json > paper.json
    fullswarm experiment run paper --engine kinematic --out results/kinematic --json > kinematic.json
    fullswarm results report results/paper --plots docs/results/paper
    python docs/results/write.py paper paper.json kinematic.json
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
HEADERS = (
    "group", "behaviour", "engine", "limits", "scenarios", "N", "trials", "collisions", "pairs", "robots touched",
    "robots arrived %", "trials arrived %", "longest s", "blocked",
    "settled %", "quiet s", "reversals 1/s", "speed variation m/s²", "turn variation rad/s²",
)  # fmt: skip
Cell = dict[str, Any]


def label(cell: Cell) -> str:
    """Return a behaviour with its parameters."""
    return " ".join((cell["behaviour"], *(f"{name}={value}" for name, value in cell["parameters"].items())))


def counted(cell: Cell) -> int:
    """Return how many trials count: those with an outcome that began in the safe set."""
    return int(cell["seeds"] - cell["failed"] - cell["unsafe_starts"])


def total(cells: Iterable[Cell], name: str) -> Any:
    """Return the sum of a number over cells; of one that is unknown nothing is added."""
    return sum(cell.get(name) or 0 for cell in cells)


def share(cells: list[Cell], name: str, robots: bool) -> float:
    """Return a share over cells in %, weighted by robots or by trials."""
    weights = [counted(cell) * (cell["robots"] if robots else 1) for cell in cells]
    parts = (weight * (cell[name] or 0.0) for weight, cell in zip(weights, cells, strict=True))
    return 100.0 * sum(parts) / max(1, sum(weights))


def mean(cells: list[Cell], name: str) -> str:
    """Return the mean of a number per robot and second over cells, weighted by robots and trials."""
    known = [(counted(cell) * cell["robots"], cell[name]) for cell in cells if cell.get(name) is not None]
    weight = sum(count for count, _ in known)
    return f"{sum(count * value for count, value in known) / weight:.2f}" if weight else "-"


def quiet(cells: list[Cell]) -> str:
    """Return the longest motion after the last progress, of the trials in which not all arrived."""
    longest = [cell["quiet_s"] for cell in cells if cell.get("quiet_s") is not None]
    restless = sum(cell.get("never_quiet") or 0 for cell in cells)
    return (
        ", ".join([f"{max(longest, default=0.0):.1f}"] * bool(longest) + [f"{restless} never"] * bool(restless)) or "-"
    )


def counts(document: dict[str, Any]) -> str:
    """Return the sentence with which a document begins."""
    cells = document["cells"]
    expected = total((cell for cell in cells if cell["collisions_expected"]), "collisions")
    return (
        f"{document['trials_done']} trials, {document['trials_failed']} failed, {total(cells, 'collisions')} "
        f"collisions ({total(cells, 'pairs_touched')} pairs, {total(cells, 'robots_touched')} robots touched), "
        f"{expected} of them\nin rows outside the assumptions, "
        f"{total(cells, 'commands_above_limits')} commands above\nthe limits, {total(cells, 'unsafe_starts')} starts "
        f"outside the safe set; {document['simulated_s']:.0f} s simulated."
    )


def collided(cells: list[Cell]) -> str:
    """Return a list of the trials with a collision, empty when there is none."""
    lines = [
        f"- {cell['group']}: {label(cell)}, {cell['scenario']}, {cell['engine']}, {cell['limits']}, N = "
        f"{cell['robots']}: seeds {', '.join(map(str, cell['colliding_seeds']))}"
        for cell in cells
        if cell["colliding_seeds"] and not cell["collisions_expected"]
    ]
    return "\n".join(("", "Collided:", "", *lines, "")) if lines else ""


def write_safety(document: dict[str, Any]) -> None:
    """Write ``safety.md``: the head and the table; what stands below the table stays."""
    rows: dict[tuple[str, ...], list[Cell]] = {}
    for cell in document["cells"]:
        rows.setdefault((cell["group"], label(cell), cell["engine"], cell["limits"]), []).append(cell)
    lines = [
        "# Safety: the table",
        "",
        "`fullswarm experiment run safety --json`, seeds 0-19 or fewer, two processes on a 2-core machine. "
        + counts(document),
        "Scenarios and what counts: `evaluate/experiment/safety.toml`; pairs and robots touched beside collisions, and",
        "how contacts are judged: [decision 21](../decisions/0021-contacts.md). Written by `docs/results/write.py`.",
        "",
        f"| {' | '.join(HEADERS)} |",
        "|---" * len(HEADERS) + "|",
    ]
    for key, cells in rows.items():
        entries = (
            *key,
            ", ".join(dict.fromkeys(cell["scenario"] for cell in cells)),
            ", ".join(map(str, sorted({cell["robots"] for cell in cells}))),
            str(sum(map(counted, cells))),
            *(str(total(cells, name)) for name in ("collisions", "pairs_touched", "robots_touched")),
            f"{share(cells, 'arrived_fraction', robots=True):.2f}",
            f"{share(cells, 'all_arrived_fraction', robots=False):.1f}",
            f"{max(cell['longest_s'] or 0.0 for cell in cells):.1f}",
            str(total(cells, "deadlocks")),
            f"{100.0 * total(cells, 'settled') / max(1, sum(counted(cell) * cell['robots'] for cell in cells)):.2f}",
            quiet(cells),
            *(mean(cells, name) for name in ("reversals_per_s", "speed_variation_m_s2", "turn_variation_rad_s2")),
        )
        lines.append(f"| {' | '.join(entries)} |")
    path = HERE / "safety.md"
    below = path.read_text("utf-8").partition("\n\n`move_to_goal_bc` is ")
    path.write_text("\n".join(lines) + "\n" + collided(document["cells"]) + "\n" + "".join(below[1:]).lstrip(), "utf-8")


def write_paper(document: dict[str, Any], kinematic: dict[str, Any]) -> None:
    """Write the figures into ``paper/README.md``."""
    cells = document["cells"]
    bare = [cell for cell in cells if cell["collisions_expected"]]
    filtered = [cell for cell in cells if not cell["collisions_expected"]]
    ran = (
        f"{document['trials_done']} trials done, {document['trials_failed']} failed, {document['simulated_s']:,.0f} s "
        f"simulated in {document['wall_s']:.0f} s with\nPyBullet; {kinematic['simulated_s']:,.0f} s in "
        f"{kinematic['wall_s']:.0f} s with the kinematic engine"
    )
    robots = sum(counted(cell) * cell["robots"] for cell in bare)
    touched = (
        f"Contacts: {total(bare, 'collisions'):,} without the filter ({total(bare, 'pairs_touched'):,} pairs of "
        f"robots; {total(bare, 'robots_touched'):,} of\n{robots:,} robots touched something), "
        f"**{total(filtered, 'collisions')} with it**, in all {len(filtered)} cells."
    )
    path = HERE / "paper" / "README.md"
    text = path.read_text("utf-8")
    text = re.sub(r"\d+ trials done,.*? with the kinematic engine", lambda _: ran, text, flags=re.S)
    text = re.sub(r"Contacts: .*? cells\.", lambda _: touched, text, flags=re.S)
    path.write_text(text, "utf-8")


def main() -> None:
    """Write one of the documents."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("which", choices=("safety", "paper"))
    parser.add_argument("json", type=Path, nargs="+")
    options = parser.parse_args()
    documents = [json.loads(each.read_text("utf-8")) for each in options.json]
    if options.which == "safety":
        write_safety(documents[0])
    else:
        write_paper(*documents)


if __name__ == "__main__":
    main()
