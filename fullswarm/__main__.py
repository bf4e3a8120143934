"""``python -m fullswarm``: the same entry point as the ``fullswarm`` command, and that of a robot's unit."""

import sys

from fullswarm.launch import unit

if __name__ == "__main__":
    if on_board := unit.asked_for(sys.argv[1:]):
        sys.exit(unit.main(*on_board))
    from fullswarm.cli.main import main

    main()
