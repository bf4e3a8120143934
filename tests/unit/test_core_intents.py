"""Intents that wait or are resent live no longer for it."""

from __future__ import annotations

from fullswarm.messages import ControlRequest, HealthReport, Message
from tests.unit.core_swarm import Swarm


def test_an_intent_resent_after_a_loss_lives_no_longer() -> None:
    swarm = Swarm(count=1)
    began_s = swarm.runtime.now_s()
    lost: list[Message] = []

    def drop(_key: str, message: Message) -> bool:
        lose = isinstance(message, ControlRequest) and len(lost) < 1
        lost.extend([message] if lose else [])
        return lose

    swarm.bus.drop = drop
    swarm.ask("i", "drive", "r0", linear=1.0)
    swarm.run(0.25)
    task = swarm.robots["r0"].task
    assert task is not None
    sent_s = next(at for at, _, m in swarm.messages if isinstance(m, ControlRequest) and m.enable)
    assert sent_s > began_s + 0.05
    assert sent_s + task.expires_s <= began_s + 0.3 + 1e-6
    swarm.close()


def test_an_intent_that_had_to_wait_for_a_disable_lives_no_longer() -> None:
    swarm = Swarm(count=1)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.drop = lambda _key, message: isinstance(message, ControlRequest | HealthReport)
    began_s = swarm.runtime.now_s()
    swarm.ask("i", "drive", "r0", linear=1.0)
    swarm.run(0.15)
    swarm.bus.drop = lambda _key, _message: False
    swarm.run(0.3)
    enables = [(at, m) for at, _, m in swarm.messages if isinstance(m, ControlRequest) and m.enable and m.expires_s]
    for at, message in enables:
        assert at + message.expires_s <= began_s + 0.3 + 1e-6
    swarm.close()


def test_an_intent_is_not_carried_out_after_the_interval_when_the_stick_is_long_released() -> None:
    swarm = Swarm(count=1, interval_s=5.0)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    swarm.ask("i", "drive", "r0", linear=1.0)
    swarm.run(0.1)
    assert swarm.robots["r0"].behaviour == "drive", "a stick waits for no interval"
    swarm.run(0.5)
    switches = len(swarm.robots["r0"].log)
    swarm.run(6.0)
    assert len(swarm.robots["r0"].log) == switches
    swarm.close()
