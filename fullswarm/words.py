"""Words that both ends of the wire must agree on: what an id may look like, names with a meaning of their own."""

from __future__ import annotations

import re

ROBOT_ID = re.compile(r"[A-Za-z0-9_-]{1,64}\Z")
"""What a robot id, a swarm name or a behaviour name may look like: one plain chunk of a key."""

TRUTH = "truth"
"""The host of a supervisory process that measures the true bodies (paper II.F.1); no robot may be called so."""

STOP = "stop"
"""The behaviour that enables nothing."""
