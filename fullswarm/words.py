"""Words that both ends of the wire must agree on: what an id may look like, how reasons begin."""

from __future__ import annotations

import re

ROBOT_ID = re.compile(r"[A-Za-z0-9_-]{1,64}\Z")
"""What a robot id, a swarm name or a behaviour name may look like: one plain chunk of a key."""

TRUTH = "truth"
"""The host of a supervisory process that measures the true bodies (paper II.F.1); no robot may be called so."""

STOP = "stop"
"""The behaviour that enables nothing."""

STOPPED_BY = "it was stopped by"
"""How the reason of a robot begins that stands because somebody asked for that: no cause for alarm."""

ESTOP_WAS = "its e-stop was"
"""The same for an e-stop, engaged or released: that it is latched stands elsewhere."""

ESTOP_LATCHED = "its e-stop is latched"
"""How a robot's refusal begins that only the release of its e-stop ends."""

LAPSED = "the operator's intent has run out"
"""Why a robot stands whose stick was let go."""
