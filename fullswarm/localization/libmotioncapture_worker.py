"""Talks to a capture system through `motioncapture`: TYPE HOST [KEY=VALUE...]; prints a JSON line per frame."""

import json
import os
import sys

import motioncapture


def main(kind: str, host: str, *options: str) -> None:
    """Write a line per frame until stdout is closed."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the libraries below print to stdout
    settings = {"hostname": host, **dict(each.split("=", 1) for each in options)}
    system = motioncapture.connect(kind, settings)
    while True:
        system.waitForNextFrame()
        bodies = []
        for name, body in system.rigidBodies.items():
            turn = body.rotation
            bodies.append([name, *(float(each) for each in body.position), turn.x, turn.y, turn.z, turn.w])
        print(json.dumps(bodies), file=out, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
