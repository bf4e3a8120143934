"""Draw the pictures of all behaviours and write the page that shows them, docs/behaviours.md.

``python docs/draw_behaviours.py`` takes about a minute and needs the extras core, sim and experiments; with names it
draws only these, and the whole page is written anew.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image

from fullswarm.core.behaviours import Record, load_records, make_record
from fullswarm.lab import gallery

FOLDER = Path(__file__).parent
PICTURES = FOLDER / "behaviours"
WIDTH_PX = 440
COLOURS = 32
HEAD = """# The behaviours

Each picture is a run in lockstep, seen from above: small rings are starts, lines ways, discs with a nose the robots at
the end. Draw one yourself, with other numbers:

    fullswarm behaviours picture dispersion_bc --count 20 --set spacing_m=1.5 -o spread.png

`fullswarm behaviours NAME` lists all parameters with units and ranges. A name that ends in `_bc` runs behind the safety
filter, and is the one that is drawn. The control laws are in `fullswarm/agent/behaviours/`, those of centralised
behaviours in `fullswarm/core/centralised/behaviours/`, each with its source. `python docs/draw_behaviours.py` writes
this page.
"""


def drawn_name(name: str, names: set[str]) -> str:
    """Return the filtered variant if there is one."""
    return name + gallery.FILTERED if name + gallery.FILTERED in names else name


def draw(name: str, path: Path) -> None:
    """Write one picture, in few colours."""
    gallery.draw(name, gallery.scene_of(name, {}, {}), path, WIDTH_PX)
    with Image.open(path) as found:
        few = found.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    file = io.BytesIO()
    few.save(file, "PNG", optimize=True)
    path.write_bytes(file.getvalue())
    sys.stdout.write(f"{path.name}: {len(file.getvalue())} bytes\n")


def section(record: Record, drawn: str) -> str:
    """Return the part of the page about one behaviour."""
    required = [f"`{key}`" for key, each in record.parameters.items() if each.required]
    needs = f" Needs {', '.join(required)}." if required else ""
    where = " Computed on the base station." if record.centralised else ""
    names = f"`{record.name}`" + (f", `{drawn}`" if drawn != record.name else "")
    picture = f"![{record.summary}](behaviours/{record.name}.png)"
    return f"\n## {record.name}\n\n{names}: {record.summary}.{where}{needs}\n\n{picture}\n"


def main() -> None:
    """Draw and write."""
    tables = load_records()
    names = set(tables)
    base = [name for name in tables if name.removesuffix(gallery.FILTERED) not in names - {name}]
    PICTURES.mkdir(exist_ok=True)
    for name in base:
        if not sys.argv[1:] or name in sys.argv[1:]:
            draw(drawn_name(name, names), PICTURES / f"{name}.png")
    sections = [section(make_record(name, tables), drawn_name(name, names)) for name in base]
    (FOLDER / "behaviours.md").write_text(HEAD + "".join(sections), encoding="utf-8")


if __name__ == "__main__":
    main()
