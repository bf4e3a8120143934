"""How smoothly the console's page draws: frames per second and work per frame, with 32 and 100 robots at 20 Hz.

``python -m benchmarks.console_page [--robots 32 100] [--seconds 10] [--json]``. Debian's Chromium, headless and without
a graphics card: every pixel is drawn by the processor, which also carries the robots, the hub and the console, so a
laptop does better. The reference in the same run is a page that only counts frames. The page's own figures
(`window.fullswarm.stats`) are over its last 240 frames.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import asdict, dataclass

from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.console import Bench

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
             "--disable-component-update", "--disable-sync"]  # fmt: skip
WORK_MS = 1000.0 / 60.0
"""What a page may need for a frame if it is to keep up with 60 Hz."""
COUNT = """() => {
  window.counted = 0;
  const count = () => { window.counted += 1; requestAnimationFrame(count); };
  requestAnimationFrame(count);
}"""


@dataclass
class Row:
    """One measurement."""

    robots: int
    fps: float
    interval_ms_p95: float  # from frame to frame
    work_ms_p95: float  # of the page, per frame
    bare_fps: float  # of a page that draws nothing, with the same robots


def draw(page: Page, bench: Bench, seconds: float) -> dict[str, float]:
    """Let the robots move for a while under an open page; return its figures."""
    page.goto(bench.url)
    bench.swarm.runtime.run(seconds)
    stats: dict[str, float] = page.evaluate("({ ...window.fullswarm.stats })")
    shown = page.evaluate("Object.keys(window.fullswarm.state.robots).length")
    if shown != bench.robots:
        raise SystemExit(f"the page shows {shown} of {bench.robots} robots")
    return stats


def measure(browser: Browser, robots: int, seconds: float) -> Row:
    """Return the figures for so many robots."""
    bench = Bench(robots)
    try:
        context = browser.new_context(viewport={"width": 1440, "height": 900})
        page = context.new_page()
        page.evaluate(COUNT)
        bench.swarm.runtime.run(seconds)
        bare_fps = page.evaluate("window.counted") / seconds
        stats = draw(page, bench, seconds)
        context.close()
        return Row(robots, stats["fps"], stats["interval_ms_p95"], stats["frame_ms_p95"], bare_fps)
    finally:
        bench.close()


def main() -> int:
    """Print the rows; return 1 when 32 robots cost more than a frame's time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[32, 100])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        rows = [measure(browser, robots, options.seconds) for robots in options.robots]
        browser.close()
    if options.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        print("robots   fps  bare page  ratio  interval p95  work p95 (headless, drawn by the processor)")
        for row in rows:
            print(
                f"{row.robots:6d} {row.fps:5.1f} {row.bare_fps:10.1f} {row.fps / row.bare_fps:6.2f} "
                f"{row.interval_ms_p95:10.1f} ms {row.work_ms_p95:6.1f} ms"
            )
    return int(any(row.robots <= 32 and row.work_ms_p95 > WORK_MS for row in rows))


if __name__ == "__main__":
    sys.exit(main())
