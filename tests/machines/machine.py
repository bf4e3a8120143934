"""A machine in QEMU's memory: it boots a kernel, says facts on its second serial port, and ends."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.machines.needs import which

CLOCK = ("-accel", "tcg,thread=single", "-icount", "shift=1,sleep=off")
"""A nanosecond of the guest's is half an instruction: its time stands still while this machine does something else,
and leaps while the guest has nothing to do. So no load of this machine makes a guest miss its deadlines."""

LIVE = ("-accel", "tcg,thread=single", "-icount", "shift=1")
"""The same for a guest that talks to this machine: its time is never ahead of ours."""

KERNEL = "console=ttyS0 panic=-1 mitigations=off net.ifnames=0 loglevel=4"


class Machine:
    """A QEMU process. Its console goes to a file; a guest that is not `live` says facts, one JSON document a line."""

    def __init__(
        self, folder: Path, kernel: Path, initramfs: Path, memory_mib: int, options: Sequence[str], *, live: bool
    ) -> None:
        self._console, self._facts = folder / "console.log", folder / "facts.jsonl"
        facts = () if live else ("-serial", f"file:{self._facts}")
        program = which("qemu-system-x86_64")
        assert program is not None
        self._process = subprocess.Popen(
            [program, *(LIVE if live else CLOCK), "-cpu", "Nehalem", "-smp", "1", "-m", str(memory_mib),
             "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot",
             "-kernel", str(kernel), "-initrd", str(initramfs), "-append", KERNEL,
             "-serial", f"file:{self._console}", *facts, *options],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip

    def close(self) -> None:
        """Pull the plug."""
        self._process.kill()
        self._process.communicate()

    def wait_for_end(self, limit_s: float) -> None:
        """Wait until it has switched itself off; fail with what it said if it never does."""
        deadline_s = time.monotonic() + limit_s
        while self._process.poll() is None:
            assert time.monotonic() < deadline_s, f"the guest is still running after {limit_s:.0f} s\n{self.story()}"
            time.sleep(0.1)

    def facts(self) -> list[dict[str, Any]]:
        """Return what it has said."""
        lines = self._facts.read_text(errors="replace").splitlines() if self._facts.exists() else []
        return [json.loads(each) for each in lines if each.startswith("{") and each.endswith("}")]

    def story(self) -> str:
        """Return the end of its console."""
        return self._console.read_text(errors="replace")[-6000:] if self._console.exists() else "it said nothing"


@contextmanager
def booted(
    folder: Path,
    kernel: Path,
    initramfs: Path,
    *,
    memory_mib: int = 1024,
    options: Sequence[str] = (),
    live: bool = False,
) -> Iterator[Machine]:
    """Switch a machine on, and off at the end; a `live` one talks to this machine through its `options`."""
    machine = Machine(folder, kernel, initramfs, memory_mib, options, live=live)
    try:
        yield machine
    finally:
        machine.close()
