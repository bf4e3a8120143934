"""Runs scripts written for the Robotarium's Python simulator (package ``rps``) in a laboratory of this package.

The module tree, names, signatures, defaults and constants are those of ``rps``; everything is implemented anew, from
the equations in the papers that the files name. Three ways to run a script:

- ``python -m fullswarm.robotarium script.py``: the script stays as it is
- ``import fullswarm.robotarium.as_rps`` as its first line
- ``fullswarm.robotarium`` in place of ``rps`` in its imports

Files:

``robotarium.py``      the testbed: poses, velocities, steps, and the report at a script's end
``robotarium_abc.py``  the same class under the name of its interface in ``rps``
``figure.py``          draws the testbed with matplotlib
``as_rps.py``          when imported, makes ``import rps`` mean this package
``utilities/``         controllers, mappings between robot models, barrier certificates, graphs
"""

from __future__ import annotations

import importlib.util
import sys
from contextlib import suppress

from fullswarm.errors import MissingExtra

for _needed in ("matplotlib", "osqp", "scipy"):
    if importlib.util.find_spec(_needed) is None:
        raise MissingExtra(f"scripts of the Robotarium need {_needed}", hint="pip install 'fullswarm[lab]'")


def _import_numba() -> None:
    """Import numba while the script's own folder is not searched: numba imports `coverage`, a likely script's name."""
    path = sys.path[:]
    sys.path[:] = path[1:]
    try:
        with suppress(ImportError):  # kernels run without it, slower
            importlib.import_module("numba")
    finally:
        sys.path[:] = path


_import_numba()
