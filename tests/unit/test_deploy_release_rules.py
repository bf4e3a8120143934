"""The rules of what may go on board, without a resolver: targets, extras, bounds."""

from __future__ import annotations

import pytest

from fullswarm.deploy.release import targets
from fullswarm.deploy.release.packages import HEAVY, NEVER, check_extras, check_versions, package_name, requirements
from fullswarm.errors import ConfigError

NEEDS = requirements()
GOOD = {package_name(each): "99.0" for each in NEEDS.always}


def test_the_usual_python_of_a_target_can_be_changed() -> None:
    assert targets.target("rpi-arm64").python == "3.11"
    trixie = targets.target("rpi-arm64", "3.13")
    assert (trixie.name, trixie.arch, trixie.python) == ("rpi-arm64", "aarch64", "3.13")
    assert targets.target("x86_64").python == targets.THIS_PYTHON


@pytest.mark.parametrize("name", ["armhf", "armv7l", "i686", "rpi-arm32"])
def test_32_bit_is_refused_in_so_many_words(name: str) -> None:
    with pytest.raises(ConfigError, match="64-bit systems only"):
        targets.target(name)


def test_a_mistyped_target_is_guessed() -> None:
    with pytest.raises(ConfigError) as caught:
        targets.target("rpi-arm46")
    assert "rpi-arm64" in caught.value.hint


def test_the_python_of_jetpack_6_is_refused_with_the_way_out() -> None:
    with pytest.raises(ConfigError, match=r"Python 3\.10") as caught:
        targets.target("jetson", "3.10")
    assert "apt install python3.11" in caught.value.hint


def test_our_own_requirements_are_known_with_their_bounds() -> None:
    lowest = NEEDS.lowest(("mavlink",))
    assert lowest["eclipse-zenoh"] == "1.10"
    assert "pymavlink" in lowest
    assert "pymavlink" not in NEEDS.lowest(())


def test_fullswarm_alone_brings_nothing_heavy() -> None:
    check_versions(GOOD, NEEDS, ())
    assert not {*NEVER, *HEAVY} & set(NEEDS.lowest(("can", "mavlink")))


@pytest.mark.parametrize("version", ["0.10.0rc0", "1.9.9", "0.11", "1"])
def test_an_ancient_zenoh_is_an_error_that_says_so(version: str) -> None:
    with pytest.raises(ConfigError, match=f"eclipse-zenoh {version} is too old: fullswarm needs 1.10"):
        check_versions({**GOOD, "eclipse-zenoh": version}, NEEDS, ())


@pytest.mark.parametrize("version", ["1.10", "1.10.0", "1.10.2", "2.0rc1", "1.11"])
def test_a_zenoh_that_does(version: str) -> None:
    check_versions({**GOOD, "eclipse-zenoh": version}, NEEDS, ())


def test_a_missing_package_is_named() -> None:
    without = {name: version for name, version in GOOD.items() if name != "numpy"}
    with pytest.raises(ConfigError, match="numpy is missing"):
        check_versions(without, NEEDS, ())


@pytest.mark.parametrize("name", ["pybullet", "numba", "matplotlib"])
@pytest.mark.parametrize("extras", [(), ("core", "can")])
def test_simulators_and_plots_stay_ashore(name: str, extras: tuple[str, ...]) -> None:
    plan = {**GOOD, "osqp": "9", "scipy": "9", "shapely": "9", name: "9"}
    with pytest.raises(ConfigError, match=f"{name} must not be on a robot"):
        check_versions(plan, NEEDS, extras)


def test_scipy_only_where_it_was_asked_for() -> None:
    with pytest.raises(ConfigError, match="--with core"):
        check_versions({**GOOD, "scipy": "1.17"}, NEEDS, ())
    check_versions({**GOOD, "scipy": "1.17", "osqp": "1.1", "shapely": "2.0"}, NEEDS, ("core",))


@pytest.mark.parametrize("name", ["sim", "experiments", "mavlnk"])
def test_an_extra_of_the_base_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"'{name}' is not an extra for robots"):
        check_extras(("can", name))
