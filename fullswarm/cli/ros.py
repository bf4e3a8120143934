"""`fullswarm ros`: shows a live swarm to ROS 2 and ROS 1, and takes their commands."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli.options import shell_command
from fullswarm.errors import MissingExtra

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget

ros_app = typer.Typer(help="Show a live swarm to ROS 2 and ROS 1, and take their commands.", no_args_is_help=True)


class Keys(StrEnum):
    """Whose keys ROS 2 uses on its zenoh."""

    zenoh = "zenoh"
    bridge = "bridge"


@ros_app.callback()
def _group() -> None:
    """Keep `bridge` a command of its own, although it is the only one."""


@ros_app.command()
@shell_command(logs=True, needs="posix")
def bridge(
    target: NamedTarget,
    ros2: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="ROS 2: its zenoh router or bridge, like tcp/127.0.0.1:7447."),
    ] = None,
    keys: Annotated[
        Keys, typer.Option(help="Keys of ROS 2: those of rmw_zenoh, or of zenoh-bridge-ros2dds (`bridge`).")
    ] = Keys.zenoh,
    domain: Annotated[int, typer.Option(metavar="N", help="The ROS domain, for rmw_zenoh.")] = 0,
    ros1: Annotated[
        str | None,
        typer.Option(metavar="URI", help="ROS 1: its master, like http://127.0.0.1:11311; '': $ROS_MASTER_URI."),
    ] = None,
    ros1_python: Annotated[str, typer.Option(metavar="FILE", help="The Python that has rospy.")] = "/usr/bin/python3",
    namespace: Annotated[str, typer.Option(metavar="NAME", help="Put this before the name of every topic.")] = "",
    scans: Annotated[
        float,
        typer.Option(
            metavar="HZ", min=0.0, max=20.0, help="Ask robots for their range scans so often; 0: show no scans."
        ),
    ] = 5.0,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Carry out velocities and requests of ROS as this operator.")
    ] = False,
) -> int:
    """Show a live swarm to ROS until Ctrl-C: odometry, tf, battery, scans, map, markers, diagnostics."""
    import importlib.util

    if importlib.util.find_spec("rosbags") is None:
        raise MissingExtra("a bridge to ROS needs the package rosbags", hint="pip install 'fullswarm[ros-bridge]'")
    from fullswarm.ros_bridge.bridge import Options
    from fullswarm.ros_bridge.session import Sides
    from fullswarm.ros_bridge.session import bridge as run

    options = Options(namespace.strip("/"), allow_commands, scans)
    return run(target, Sides(ros2, keys.value, domain, ros1, ros1_python), options)
