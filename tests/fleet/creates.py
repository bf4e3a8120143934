"""The emulated Creates of a lab, in one process: ``python -m tests.fleet.creates PORT…`` until it is ended.

They stand outside the robots' computers, as real ones do: a computer that loses its power leaves its Create alone.
Their ports are the base's pseudo-terminals, handed into the containers as devices of the group `dialout`. A line
``mute N`` on stdin lets the Nth, from 0, say nothing any more; ``speak N`` takes it back.
"""

from __future__ import annotations

import os
import select
import sys
from contextlib import ExitStack
from pathlib import Path

from fullswarm.emulators.create_oi.emulator import CreateEmulator

DIALOUT = 20
WAKE_S = 60.0


def main(ports: list[str]) -> None:
    """Serve until the end of stdin."""
    with ExitStack() as stack:
        creates = [stack.enter_context(CreateEmulator(port=port)) for port in ports]
        for port in ports:
            terminal = Path(port).resolve()
            os.chown(terminal, 0, DIALOUT)
            terminal.chmod(0o660)
        _say("ready")
        while True:
            for create in creates:  # a wire to the BRC pin: nobody walks round to press power buttons
                create.brc(low=True)
                create.brc(low=False)
            if not select.select([sys.stdin], [], [], WAKE_S)[0]:
                continue
            if not (line := sys.stdin.readline()):
                return
            order, row = line.split()
            creates[int(row)].mute(order == "mute")
            _say(f"done {line.strip()}")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
