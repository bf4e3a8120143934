"""What QEMU runs for a connection out of a guest that has no other way out: its bytes to a port of this computer."""

from __future__ import annotations

import os
import select
import socket
import sys


def main() -> None:
    """Carry bytes between stdin, stdout and the port on loopback that the command line names."""
    with socket.create_connection(("127.0.0.1", int(sys.argv[1]))) as line:
        while True:
            ready, _, _ = select.select([0, line.fileno()], [], [])
            if 0 in ready:
                data = os.read(0, 65536)
                if not data:
                    return
                line.sendall(data)
            if line.fileno() in ready:
                data = line.recv(65536)
                if not data:
                    return
                while data:
                    data = data[os.write(1, data) :]


if __name__ == "__main__":
    main()
