"""The heap of a process that runs for weeks: what was built once is not collected again, and free memory goes back.

After a burst the C library keeps all that lies below a block still in use. While a node's loop waits a second or two
for a busy processor, some thousand messages wait for it; of a core after that, 6 of 92 MB were free and not returned.
"""

from __future__ import annotations

import ctypes
import gc
from contextlib import suppress

from fullswarm.runtime import Scheduler

RETURN_S = 60.0


def settle(scheduler: Scheduler) -> None:
    """Exempt all that is built so far from garbage collection, and return free memory each minute from now on.

    Without the first each full collection would cost 20 ms. The second takes 0.2 ms for each MB, and needs the C
    library of most Linux systems, glibc; elsewhere it is left out.
    """
    gc.collect()
    gc.freeze()
    with suppress(AttributeError, OSError, TypeError):  # a C library without it; a system without one for all programs
        trim = ctypes.CDLL(None).malloc_trim
        trim.argtypes = (ctypes.c_size_t,)
        scheduler.every(RETURN_S, lambda: trim(0))
