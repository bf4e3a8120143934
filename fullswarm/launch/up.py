"""`fullswarm up FLEET.toml`: all processes of a fleet file on this machine, until Ctrl-C."""

from __future__ import annotations

import sys

from fullswarm.bus.endpoint import check_endpoint
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.errors import ConfigError
from fullswarm.launch.supervisor import Supervisor
from fullswarm.runtime import Runtime


def run(config: SwarmConfig, insecure_network: bool) -> int:
    """Start the processes, start those again that die, end all in order on Ctrl-C or SIGTERM."""
    if not config.robot:
        raise ConfigError("names no robot", where="the fleet file", hint="add [[robot]] tables or a [fleet] count")
    check_endpoint(config.hub.endpoint, insecure_network)
    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    supervisor = Supervisor(config, runtime, insecure_network=insecure_network)
    try:
        supervisor.start()
        print(  # noqa: T201
            f"{len(config.robot)} robots of swarm '{config.swarm}' at {config.hub.endpoint}; "
            f"logs in {supervisor.folder}; Ctrl-C ends all.\n"
            "In another terminal: `fullswarm watch`, `fullswarm behaviours`, `fullswarm stop`",
            file=sys.stderr,
        )
        runtime.run()
    finally:
        supervisor.close()
    return 130 if runtime.exit_signal == 2 else 0
