"""``python -m fullswarm``: the same entry point as the ``fullswarm`` command."""

from fullswarm.launch.main import main

if __name__ == "__main__":
    main()
