"""A card of a secured fleet carries the robot's certificate, once, where the first boot removes it from the card."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import pytest

from fullswarm.config import SwarmConfig
from fullswarm.deploy.flash.payload import BootPartition, Shipment, Surroundings, boot_files
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.robot.support_package import ISSUED_TO
from fullswarm.errors import ConfigError
from fullswarm.identity.authority import Authority
from fullswarm.identity.folder import IDENTITY, KeysFolder

FLEET = SwarmConfig.model_validate({"hub": {"endpoint": "tls/10.0.0.1:7447"}, "robot": [{"id": "r1"}, {"id": "r2"}]})
PARTITION = BootPartition("bootfs", "", frozenset({"user-data", "meta-data"}), lambda name: None)


def card(keys: Keys, robot: int) -> dict[str, bytes]:
    shipment = Shipment("1.0-0123456789ab", b"head", b"body", 1, 4, "3.11")
    return boot_files(FLEET.robot[robot], Surroundings(FLEET), keys, shipment, PARTITION, "auto")[0]


def test_a_card_carries_the_private_key_in_the_support_package_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(IDENTITY, str(tmp_path / "identity"))
    made, _ = Authority.make(KeysFolder.of(FLEET.swarm)).issue("r1", "robot")
    keys = Keys(tmp_path / "keys")
    files = card(keys, 0)
    secret = made.key.read_bytes()
    assert [name for name, content in files.items() if secret in content] == ["fullswarm/kit.tar"]
    with tarfile.open(fileobj=io.BytesIO(files["fullswarm/kit.tar"])) as tar:
        member = tar.extractfile(f"files/{ISSUED_TO}/key.pem")
        assert member is not None
        assert member.read() == secret
    with pytest.raises(ConfigError, match="'r2' has no certificate"):
        card(keys, 1)
