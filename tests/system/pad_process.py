"""The real ``fullswarm`` command with a virtual gamepad plugged in, which obeys lines on stdin.

    echo '["button", "leftshoulder", true]' | python -m tests.system.pad_process joystick --pad 1

Lines are JSON lists: ``["axis", name, share]``, ``["button", name, down]``, ``["unplug"]``, ``["plug"]``.
"""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

from fullswarm.cli.main import main
from fullswarm.testing.pad import VirtualPad


def obey(pad: VirtualPad) -> None:
    """Do what stdin says; the joystick command itself never reads it."""
    for line in sys.stdin:
        verb, *what = json.loads(line)
        if verb == "plug":
            pad = VirtualPad()
        else:
            act: Any = getattr(pad, verb)
            act(*what)


if __name__ == "__main__":
    threading.Thread(target=obey, args=(VirtualPad(),), daemon=True).start()
    main()
