"""Makes ``import rps`` mean this package: one line at the top of a script that stays as it is.

    import fullswarm.robotarium.as_rps  # noqa: F401
    import rps.robotarium as robotarium
    from rps.utilities.controllers import *

It must come before the first import of ``rps``; a package ``rps`` that is installed is not touched.
"""

from __future__ import annotations

import sys

import fullswarm.robotarium
import fullswarm.robotarium.robotarium
import fullswarm.robotarium.robotarium_abc
import fullswarm.robotarium.utilities.barrier_certificates
import fullswarm.robotarium.utilities.barrier_certificates2
import fullswarm.robotarium.utilities.controllers
import fullswarm.robotarium.utilities.graph
import fullswarm.robotarium.utilities.misc
import fullswarm.robotarium.utilities.transformations
from fullswarm.errors import ConfigError

_OURS = "fullswarm.robotarium"

_present = sys.modules.get("rps")
if _present is not None and _present is not fullswarm.robotarium:
    raise ConfigError(
        "the package rps is imported already", where=_OURS,
        hint="import fullswarm.robotarium.as_rps before anything that imports rps",
    )  # fmt: skip
for _name in [each for each in sys.modules if each == _OURS or each.startswith(f"{_OURS}.")]:
    sys.modules[f"rps{_name.removeprefix(_OURS)}"] = sys.modules[_name]
