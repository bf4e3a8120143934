"""The null make: ``null://<id>``, a robot without hardware. The smallest driver, without a link.

``driver.py``  The driver: integrates its commands on a clock
"""

from __future__ import annotations

from fullswarm.drivers.make import Make

MAKE = Make(
    name="null",
    robots="null robots",
    schemes=("null",),
    driver="fullswarm.drivers.null.driver:NullDriver",
    example="null://r1",
    limits="integrates its commands, no robot",
    simulated=True,
)
