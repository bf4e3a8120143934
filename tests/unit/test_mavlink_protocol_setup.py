"""Before a connection: the extra that brings pymavlink, and what a URL may say."""

from __future__ import annotations

import builtins
import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest

from fullswarm.drivers.mavlink import codec
from fullswarm.drivers.mavlink.settings import LIMITS, parse_url
from fullswarm.errors import ConfigError, MissingExtra


def test_pymavlink_is_not_imported_with_the_package() -> None:
    code = "import sys, fullswarm.drivers.mavlink.driver; sys.exit('pymavlink' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_mavlink_2_is_set_before_pymavlink_is_imported() -> None:
    """Without it a mavutil in the same process drops its signing at the first frame and believes anybody."""
    code = """
import builtins, os, sys
from fullswarm.drivers.mavlink.codec import dialect
real, seen = builtins.__import__, []
def watched(name, *rest, **named):
    if name.startswith("pymavlink"):
        seen.append(os.environ.get("MAVLINK20"))
    return real(name, *rest, **named)
builtins.__import__ = watched
dialect()
from pymavlink import mavutil
assert seen and set(seen) == {"1"}, seen
assert mavutil.mavlink20() and mavutil.mavlink.WIRE_PROTOCOL_VERSION == "2.0"
"""
    environment = {name: value for name, value in os.environ.items() if name != "MAVLINK20"}
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, env=environment)


def test_a_missing_extra_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("pymavlink"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtra, match=r"pip install 'fullswarm\[mavlink\]'"):
        codec.dialect.__wrapped__()


def test_urls() -> None:
    address, options = parse_url("mavlink+serial:///dev/ttyACM0?baud=57600&sysid=3")
    assert (address.device, address.baud, options) == ("/dev/ttyACM0", 57600, {"sysid": "3"})
    address, _ = parse_url("mavlink+udp://127.0.0.1:14550")
    assert (address.scheme, address.host, address.port) == ("mavlink+udp", "127.0.0.1", 14550)


@pytest.mark.parametrize(
    "url",
    [
        "mavlink+udp://127.0.0.1", "mavlink+tpc://h:1", "mavlink+serial://", "mavlink+tcp://h:99999",
        "mavlink+serial:///dev/x?baud=fast", "mavlink+udp://h:1?sysid=1&sysid=2",
    ],
)  # fmt: skip
def test_wrong_urls(url: str) -> None:
    with pytest.raises(ConfigError):
        parse_url(url)


def test_url_options() -> None:
    from fullswarm.drivers.mavlink.driver import MavlinkDriver

    driver = MavlinkDriver("mavlink+tcp://127.0.0.1:5760?speed=0.4&radius=0.2")
    assert driver.description.limits == replace(LIMITS, speed_m_s=0.4)
    assert driver.description.radius_m == 0.2
    for query in ("speed=0", "speed=nan", "turn=x", "sysid=0", "sysid=255", "ekf=maybe", "speeed=1"):
        with pytest.raises(ConfigError):
            MavlinkDriver(f"mavlink+tcp://127.0.0.1:5760?{query}")
