"""Who is meant, which release fits whom, and what all should run."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.config import SwarmConfig
from fullswarm.deploy.fleet.facts import Facts
from fullswarm.deploy.fleet.login import Address, pick_robots
from fullswarm.deploy.fleet.releases import Desired, choose_release, extras_needed, misfit
from fullswarm.deploy.release.manifest import Manifest, Target
from fullswarm.deploy.release.store import Store
from fullswarm.errors import ConfigError

RELEASE, NEWER = "1.0-0123456789ab", "1.1-0123456789ab"


FLEET = SwarmConfig.model_validate(
    {
        "robot": [{"id": "r1", "driver": "null://r1"}, {"id": "r2", "host": "10.0.0.2"}, {"id": "s1"}],
        "groups": {"all": ["r1", "s1"]},
    }
)


def test_robots_by_name_and_group() -> None:
    def ids(*named: str) -> list[str]:
        return [each.id for each in pick_robots(FLEET, named, Path("lab.toml"))]

    assert ids() == ["r1", "r2"]  # a simulated one has no computer, unless somebody says so
    assert ids("r2,r1") == ["r2", "r1"]
    assert ids("@all", "r1") == ["r1", "s1"]
    with pytest.raises(ConfigError, match=r"lab.toml: no robot 'r3' in this fleet \(known: @all, r1, r2, s1\)"):
        ids("r3")


@pytest.mark.parametrize("named", [("",), (",",), ("@spare",), ("@spare", "")])
def test_a_name_that_stands_for_nobody_is_not_the_whole_fleet(named: tuple[str, ...]) -> None:
    fleet = FLEET.model_copy(update={"groups": {"spare": ()}})
    with pytest.raises(ConfigError) as caught:
        pick_robots(fleet, named, Path("lab.toml"))
    assert f"'{' '.join(named)}' selects no robot" in str(caught.value)
    assert [each.id for each in pick_robots(fleet, (*named, "r1"), Path("lab.toml"))] == ["r1"]


def test_a_host_that_is_not_named_is_found_by_its_id() -> None:
    assert Address.of(FLEET.robot[0]) == Address("r1", "r1.local", 22, "fullswarm-admin")


def test_which_release_fits(tmp_path: Path) -> None:
    manifest = Manifest(RELEASE, "1.0", Target("rpi-arm64", "aarch64", "2.28", "3.11"))
    robot = Facts(arch="aarch64", glibc="2.36", python="3.11.2")
    assert misfit(manifest, robot) == ""
    assert misfit(manifest, Facts(arch="aarch64", python="3.10", pythons=["3.10", "3.11"])) == ""
    assert misfit(manifest, Facts(arch="armv7l", python="3.11")) == "is for aarch64, this computer is armv7l"
    assert misfit(manifest, Facts(arch="aarch64", glibc="2.9", python="3.11")) == "needs glibc 2.28, here is 2.9"
    assert misfit(manifest, Facts(arch="aarch64", python="3.13")) == "is for Python 3.11, here is 3.13"
    with pytest.raises(ConfigError, match=r"fullswarm bundle --target rpi-arm64 --python 3\.13"):
        choose_release(Store(tmp_path), None, Facts(arch="aarch64", python="3.13"), "r1")
    with pytest.raises(ConfigError, match="install a 64-bit system"):
        choose_release(Store(tmp_path), None, Facts(arch="armv7l", python="3.13"), "r1")


def test_a_release_has_what_its_robots_agents_need(tmp_path: Path) -> None:
    fleet = SwarmConfig.model_validate(
        {
            "robot": [
                {"id": "c1", "driver": "create:///dev/ttyUSB0"},
                {"id": "m1", "driver": "mavlink+serial:///dev/ttyACM0"},
                {"id": "b1", "driver": "can+odrive://can0?left=1&right=2&wheel_radius=0.05&base=0.3"},
                {
                    "id": "t1",
                    "driver": "create:///dev/ttyUSB0",
                    "ranges": "vl53l1x:///dev/i2c-1?sensor=0@0.1,0,0",
                },
            ],
        }
    )
    wanted = [extras_needed(each, fleet) for each in fleet.robot]
    assert wanted == [set(), {"mavlink"}, {"can"}, {"tof"}]
    secured = SwarmConfig.model_validate({"hub": {"endpoint": "tls/10.0.0.1:7447"}})
    also = [extras_needed(each, secured) for each in fleet.robot]
    assert also == [{"keys"}, {"keys", "mavlink"}, {"keys", "can"}, {"keys", "tof"}]
    manifest = Manifest(RELEASE, "1.0", Target("rpi-arm64", "aarch64", "2.28", "3.11"), ("can",))
    facts = Facts(arch="aarch64", glibc="2.36", python="3.11.2")
    assert misfit(manifest, facts, wanted[0]) == ""
    assert misfit(manifest, facts, wanted[1]) == "lacks what its agent needs: mavlink"
    with pytest.raises(ConfigError, match=r"no release fits it .*bundle .* --with mavlink"):
        choose_release(Store(tmp_path), None, facts, "m1", extras=wanted[1])


def test_what_robots_should_run_is_kept(tmp_path: Path) -> None:
    desired = Desired(tmp_path / "state/lab.json")
    assert desired.read() == {}
    desired.want({"r1": RELEASE, "r2": RELEASE})
    desired.want({"r2": "1.1-0123456789ab"})
    assert desired.read() == {"r1": RELEASE, "r2": "1.1-0123456789ab"}
    desired.file.write_text('{"r1": 3, "r2": "../x", "r3": "1.1-0123456789ab"}')
    assert desired.read() == {"r3": "1.1-0123456789ab"}
    desired.file.write_text("{")
    assert desired.read() == {}


def test_what_cannot_be_kept_is_a_warning_for_the_robots_have_done_their_part(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "state").write_text("no folder")
    desired = Desired(tmp_path / "state/lab.json")
    desired.want({"r1": RELEASE})
    assert f"warning: {desired.file}: cannot store what robots should run" in capsys.readouterr().err
