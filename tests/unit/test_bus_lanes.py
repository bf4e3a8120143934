"""Every key has its lane and its rate, far beyond any use; a flood of one sender passes no faster."""

from __future__ import annotations

import inspect

import pytest

from fullswarm.bus.lanes import (
    ANSWERS,
    BURST_S,
    CHANGES,
    ORDERS,
    POSES,
    READS,
    STATES,
    STOPS,
    Bucket,
    Service,
    service_of,
)
from fullswarm.config import AgentConfig
from fullswarm.keys import Keys

KEYS = Keys("lab")


@pytest.mark.parametrize(
    ("key", "service"),
    [
        (KEYS.stop, STOPS), (KEYS.estop, STOPS), (KEYS.estop_receipt("r1"), ANSWERS), (KEYS.behaviour_request, ORDERS),
        (KEYS.control_requests("r1", "drive"), ORDERS), (KEYS.command(), ORDERS), (KEYS.ack(), ANSWERS),
        (KEYS.behaviour_status, ANSWERS), (KEYS.param_changed(), CHANGES),
        (KEYS.heartbeat("core"), ORDERS), (KEYS.state(), POSES), (KEYS.pose_fix("r1"), STATES),
        (KEYS.health(), STATES), (KEYS.profile(), STATES), (KEYS.report_query, READS),
        (KEYS.param_request("core"), READS), (KEYS.measurement("robots"), READS), (KEYS.summary(), READS),
    ],
)  # fmt: skip
def test_what_concerns_safety_comes_first(key: str, service: Service) -> None:
    assert service_of(key) == service


def test_no_key_is_left_out_by_mistake() -> None:
    """Those that carry states are the ones that no line of the table names."""
    names = [name for name, each in vars(Keys).items() if not name.startswith("_") and name != "swarm"]
    keys = {}
    for name in names:
        each = getattr(KEYS, name)
        if callable(each):
            given = [key for key in inspect.signature(each).parameters if key == "layer"]
            keys[name] = each(*["core" for _ in given])
        else:
            keys[name] = each
    states = {name for name, key in keys.items() if service_of(key) == STATES}
    assert states == {
        "pose_fix", "object_fix", "fix_source", "true_poses", "world_hold",
        "broadcast", "profile", "reception", "relay", "searched", "obstacles", "health",
        "clock_probe", "clock_reply", "version",
    }  # fmt: skip
    assert {name for name, key in keys.items() if service_of(key).polled} == {"state"}, "no clock, no stop"


def test_rates_are_beyond_the_greatest_that_can_be_set() -> None:
    def most(name: str) -> float:
        return float(max(each.le for each in AgentConfig.model_fields[name].metadata if hasattr(each, "le")))

    assert STATES.rate_hz >= 2.0 * most("state_rate_hz")
    assert READS.rate_hz >= 2.0 * most("measurement_rate_hz")


def test_a_sender_gets_its_rate_and_what_it_has_saved() -> None:
    bucket = Bucket(100.0, 0.0)
    assert sum(bucket.take(0.0) for _ in range(1000)) == 100.0 * BURST_S
    taken = sum(bucket.take(0.001 * k) for k in range(10_000))  # a thousand a second, for 10 s
    assert 995 <= taken <= 1005
    assert sum(bucket.take(100.0) for _ in range(1000)) == 100.0 * BURST_S
