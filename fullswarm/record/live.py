"""`fullswarm viewer foxglove`: a recorder's node whose messages go to the viewers that connect."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from fullswarm.bus.endpoint import DEFAULT_HUB
from fullswarm.clock import wall_time_s
from fullswarm.config.fleet_file import load_swarm
from fullswarm.errors import FullswarmError
from fullswarm.launch import run_folder
from fullswarm.launch.nodes import Node
from fullswarm.launch.observer import Address, Connection, serve
from fullswarm.launch.spare import FLEET
from fullswarm.operator.session import Target
from fullswarm.output import data, data_json, progress
from fullswarm.record.recorder import Recorder
from fullswarm.record.viewer import FOXGLOVE, Channels, Web

if TYPE_CHECKING:
    from starlette.applications import Starlette

NAME = "viewer"
"""Of its certificate, where the hub is secured; its role is ``observer``, which can send nothing."""
FLUSH_S = 0.05
"""What a robot does is shown this late at most."""


def show(target: Target, listen: str, origins: frozenset[str], as_json: bool) -> int:
    """Show a live swarm to viewers until Ctrl-C; raises as `fullswarm.launch.observer.serve`.

    Parameters
    ----------
    origins : of web pages that may connect beside the known ones, in lower case
    """

    def build(to: Connection) -> tuple[Starlette, list[Node]]:
        logs, now_s = logs_of(target), to.runtime.now_s
        began_ns = round(1e9 * wall_time_s())  # last: times of messages count from here
        channels = Channels(f"fullswarm: {target.swarm}", str(began_ns), now_s)
        node = Recorder(to.bus, to.keys, to.runtime, channels, began_ns, logs, flush_s=FLUSH_S)
        return Web(channels, now_s, origins).app(), [node]

    def on_start(address: Address) -> None:
        url = f"ws://{address.shown}"
        page = f"{FOXGLOVE}/?ds=foxglove-websocket&ds.url={url}"
        if as_json:
            data_json({"url": url, "foxglove": page}, indent=None)
            return
        data(url)
        progress(f"open this in Foxglove or Lichtblick as a Foxglove WebSocket, or {page}; Ctrl-C ends")
        if not address.local:
            progress(
                f"every program that reaches {address.shown} can read all that swarm '{target.swarm}' publishes: "
                "positions, camera pictures, logs; it cannot send anything"
            )

    return serve(target, NAME, listen, build, on_start, wait=True)


def logs_of(target: Target) -> Path | None:
    """Return the folder with the logs of the swarm's processes; None: `up` runs on another computer, or as another."""
    hub = target.hub or DEFAULT_HUB
    for folder in run_folder.running():
        with contextlib.suppress(FullswarmError):  # a run that ends or begins just now, or of another version
            config = load_swarm(folder / FLEET)
            if (config.hub.endpoint, config.swarm) == (hub, target.swarm):
                return folder
    return None
