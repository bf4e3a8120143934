"""Replay: recordings of lockstep and live runs, run again by their nodes, which must do the same to the bit.

Live runs are `fullswarm demo` in real processes, of different fleets and networks; one process of each (an agent, the
core, the centralised behaviours) is killed (SIGKILL) while it runs. Lockstep runs have other seeds, bad networks, range
sensors and mixed fleets. One law of the package is changed in a copy of it, and the same recordings are run on that as
well: a difference has to be found in each. `fullswarm replay` is called as a user would.

    python -m benchmarks.replay [--lockstep 10] [--live 10] [--seconds 12] [--seed 1] [--keep FOLDER] [--check]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

import fullswarm as package

LIVE = (
    (), ("--fleet", "mixed"), ("--network", "loss=20%"), ("--network", "loss=5%,delay=100ms±50"),
    ("--set", "world.engine=kinematic"), ("--set", "world.noise.position_m=0.03"),
)  # fmt: skip
LOCKSTEP = (
    (), ("--network", "loss=20%,delay=50ms±30"), ("--set", "world.noise.position_m=0.03"), ("--fleet", "mixed"),
    ("--set", "world.ranges.rate_hz=10"),
)  # fmt: skip
LAW, OLD, NEW = "agent/behaviours/move_to_goal.py", "params.gain * error", "1.01 * params.gain * error"


def run(*arguments: str, code: Path | None = None, **more: Any) -> subprocess.CompletedProcess[str]:
    """Run `fullswarm`, of a changed copy of the package if there is one."""
    environment = {**os.environ, **({"PYTHONPATH": str(code)} if code else {})}
    command = [sys.executable, *(["-P"] if code else []), "-m", "fullswarm", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, **more)


def live(path: Path, seconds: float, options: tuple[str, ...], chance: random.Random) -> str:
    """Record a live demo of which a process is killed; return what was killed."""
    command = [sys.executable, "-m", "fullswarm", "demo", "--headless", "--seconds", str(seconds), *options]
    demo = psutil.Popen([*command, "--record", str(path)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end_s = time.monotonic() + 60.0
    while (not path.exists() or path.stat().st_size < 300_000) and time.monotonic() < end_s:
        time.sleep(0.1)
    time.sleep(chance.uniform(0.0, 0.6 * seconds))
    kind = chance.choice((" agent ", " agent ", " core ", " centralised "))
    found = [each for each in demo.children() if kind in " ".join(each.cmdline())]
    victim = chance.choice(found) if found else None
    if victim is not None:
        victim.kill()
    demo.wait(timeout=120.0)
    return kind.strip() if victim is not None else "nothing"


def replayed(path: Path, code: Path | None = None) -> tuple[int, list[dict[str, Any]]]:
    """Run a recording again; return the exit code and what came of each process."""
    found = run("replay", str(path), "--json", *(["--with-code"] if code else []), code=code)
    if not found.stdout:
        raise SystemExit(found.stderr)
    return found.returncode, json.loads(found.stdout)


def changed_package(folder: Path) -> Path:
    """Return a folder with a copy of the package whose law has another gain."""
    shutil.copytree(Path(package.__file__).parent, folder / "fullswarm", ignore=shutil.ignore_patterns("__pycache__"))
    law = folder / "fullswarm" / LAW
    text = law.read_text()
    assert OLD in text
    law.write_text(text.replace(OLD, NEW))
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lockstep", type=int, default=10)
    parser.add_argument("--live", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    chance, different, missed = random.Random(options.seed), 0, 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        code = changed_package(Path(scratch) / "changed")
        print(f"{'run':34}{'killed':13}processes  events  outputs  commands  result  with another gain")
        for number in range(options.lockstep + options.live):
            path, killed = folder / f"run{number}.mcap", "-"
            if number < options.lockstep:
                more = LOCKSTEP[number % len(LOCKSTEP)]
                name = "lockstep " + " ".join(more[1:])
                seed = ("--seed", str(options.seed + number))
                made = run("demo", "--lockstep", *seed, "--seconds", str(options.seconds), *more, "--record", str(path))
                if made.returncode not in (0, 1):
                    raise SystemExit(made.stderr)
            else:
                more = LIVE[(number - options.lockstep) % len(LIVE)]
                name = "live " + " ".join(more[1:])
                killed = live(path, options.seconds, more, chance)
            status, found = replayed(path)
            sums = [sum(each[key] for each in found) for key in ("events", "outputs", "commands")]
            different += status != 0
            troubles = {each["trouble"] for each in found if each["trouble"]}
            result = "equal" if status == 0 else "; ".join(troubles) or "different"
            _, other = replayed(path, code)
            first = min((each for each in other if each["first"]), key=lambda each: each["first"]["at_s"], default=None)
            missed += first is None
            what = "not found" if first is None else f"{first['first']['at_s']:.3f} s: {first['first']['what']}"
            print(
                f"{name:34}{killed:13}{len(found):9}{sums[0]:8}{sums[1]:9}{sums[2]:10}  {result:7} {what}", flush=True
            )
    print(f"{different} recordings replayed differently; a changed gain was not found in {missed}")
    return int(options.check and (different > 0 or missed > 0))


if __name__ == "__main__":
    sys.exit(main())
