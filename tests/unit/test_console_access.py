from __future__ import annotations

import errno
import ipaddress
import socket
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.errors import ConfigError, MissingExtra, Unreachable
from fullswarm.operator.console import serve
from fullswarm.operator.console.access import Bucket, Names, lower
from fullswarm.operator.session import Target

LOOPBACK = Names("127.0.0.1", 8807, frozenset({"lab.example", "proxy.example:9000"}))


@pytest.mark.parametrize("host", ["127.0.0.1:8807", "localhost:8807", "LOCALHOST:8807", "[::1]:8807", "lab.example",
                                  "lab.example:1234", "proxy.example:9000"])  # fmt: skip
def test_the_names_of_this_server(host: str) -> None:
    assert LOOPBACK.host(host)


@pytest.mark.parametrize("host", ["", "evil.example:8807", "127.0.0.1", "127.0.0.1:80", "127.0.0.1:8807.evil.example",
                                  "127.0.0.1.evil.example:8807", "192.168.1.5:8807", "proxy.example", "a b:8807",
                                  "localhost:8807\n", "localhost@evil.example:8807", "localhost:"])  # fmt: skip
def test_other_names_are_not(host: str) -> None:
    assert not LOOPBACK.host(host)


def test_bound_to_all_addresses_it_is_called_by_address_but_not_by_any_name() -> None:
    names = Names("0.0.0.0", 8807)
    assert names.host("192.168.1.5:8807")
    assert names.host("localhost:8807")
    assert not names.host("evil.example:8807")
    assert not names.host("192.168.1.5:80")


def test_bound_to_one_address_only_that_is_its_name() -> None:
    names = Names("192.168.1.5", 8807)
    assert names.host("192.168.1.5:8807")
    assert not names.host("localhost:8807")
    assert not names.host("192.168.1.6:8807")


def test_an_origin_is_the_server_as_it_was_called() -> None:
    assert LOOPBACK.origin("http://localhost:8807", "localhost:8807")
    for origin in ("http://127.0.0.1:8807", "http://localhost", "https://localhost:8807", "null", "", "file://"):
        assert not LOOPBACK.origin(origin, "localhost:8807"), origin
    assert LOOPBACK.origin("https://lab.example", "lab.example")  # a proxy that the user allowed speaks TLS


@given(st.text(), st.text())
def test_no_header_can_upset_the_check(host: str, origin: str) -> None:
    LOOPBACK.host(host)
    LOOPBACK.origin(origin, host)


def test_a_bucket_lets_a_burst_through_and_then_its_rate() -> None:
    bucket = Bucket(rate_hz=10.0, burst=5.0)
    assert [bucket.take(0.0) for _ in range(7)] == [True] * 5 + [False] * 2
    taken = sum(bucket.take(0.01 * step) for step in range(1, 501))
    assert 49 <= taken <= 51


# -------------------------------------------------------------------- options
@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:8807", ("127.0.0.1", 8807)),
        (":0", ("127.0.0.1", 0)),
        ("[::1]:1", ("::1", 1)),
        ("localhost:9", ("localhost", 9)),
    ],
)
def test_where_to_listen(text: str, expected: tuple[str, int]) -> None:
    assert serve.parse_listen(text, False) == expected


@pytest.mark.parametrize("text", ["", "8807", "127.0.0.1", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:70000", "::1:5"])
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(ConfigError, match="invalid address"):
        serve.parse_listen(text, True)


def test_beyond_this_machine_only_with_permission() -> None:
    for text in ("0.0.0.0:8807", "192.168.1.5:1", "base.lab:1", "[::]:1"):
        with pytest.raises(ConfigError, match="--insecure-network"):
            serve.parse_listen(text, False)
        serve.parse_listen(text, True)


def test_a_token_comes_from_file_environment_or_chance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(serve.TOKEN, raising=False)
    assert len(serve.read_token(None)) >= 32
    assert serve.read_token(None) != serve.read_token(None)
    monkeypatch.setenv(serve.TOKEN, "from-the-environment")
    assert serve.read_token(None) == "from-the-environment"
    file = tmp_path / "token"
    file.write_text("from-a-file-0123456\n")
    with pytest.raises(ConfigError, match="other users can read"):
        serve.read_token(file)
    file.chmod(0o600)
    assert serve.read_token(file) == "from-a-file-0123456"
    for wrong in ("short", "x" * 20 + " y", "x" * 20 + "#", "é" * 20):
        file.write_text(wrong)
        with pytest.raises(ConfigError, match="at least 16"):
            serve.read_token(file)
    with pytest.raises(ConfigError, match="cannot be read"):
        serve.read_token(tmp_path / "none")


def test_a_port_in_use_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(Unreachable, match="cannot listen"):
            serve.serve(Target(), serve.Options(listen=f"127.0.0.1:{port}"), lambda *_: None)


def test_the_address_has_the_token_where_no_server_sees_it() -> None:
    assert serve.url("127.0.0.1", 8807, "t") == "http://127.0.0.1:8807/#token=t"
    assert serve.url("::1", 8807, "t") == "http://[::1]:8807/#token=t"


@pytest.mark.parametrize(
    ("allowed", "expected"),
    [
        (("lab.local",), "http://lab.local:8807/#token=t"),
        (("proxy.example:9000", " Lab.local "), "http://Lab.local:8807/#token=t"),
        (("proxy.example:9000",), "http://proxy.example:9000/#token=t"),
        (("fd00::1",), "http://[fd00::1]:8807/#token=t"),
    ],
)
@pytest.mark.parametrize("everywhere", ["0.0.0.0", "::"])
def test_a_server_on_all_addresses_is_called_by_an_allowed_name(
    everywhere: str, allowed: tuple[str, ...], expected: str
) -> None:
    address = serve.url(everywhere, 8807, "t", allowed)
    assert address == expected
    assert called(Names(everywhere, 8807, lower(allowed)), address)
    assert serve.url("127.0.0.1", 8807, "t", allowed) == "http://127.0.0.1:8807/#token=t"


@pytest.mark.parametrize("everywhere", ["0.0.0.0", "::"])
def test_without_such_a_name_it_is_called_by_an_address_of_this_machine(everywhere: str) -> None:
    address = serve.url(everywhere, 8807, "t")
    assert called(Names(everywhere, 8807), address)
    own = ipaddress.ip_address(serve.own_address(everywhere))
    family = socket.AF_INET if own.version == 4 else socket.AF_INET6
    with socket.socket(family, socket.SOCK_STREAM) as listener:
        listener.bind((str(own), 0))  # nobody can listen on what is another machine's


@pytest.mark.parametrize(("everywhere", "own"), [("0.0.0.0", "127.0.0.1"), ("::", "[::1]")])
def test_a_machine_without_a_network_is_called_by_its_loopback_address(
    everywhere: str, own: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Unrouted(socket.socket):
        def connect(self, address: object) -> None:
            raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(socket, "socket", Unrouted)
    assert serve.url(everywhere, 8807, "t") == f"http://{own}:8807/#token=t"


def called(names: Names, address: str) -> bool:
    """Whether a browser that opens `address` is let in."""
    host = urlsplit(address).netloc
    return names.host(host) and names.origin(f"http://{host}", host)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    with pytest.raises(MissingExtra, match=r"fullswarm\[console\]"):
        serve.serve(Target(), serve.Options(), lambda *_: None)
