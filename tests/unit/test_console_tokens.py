"""Tokens of named operators and the passes that pages get for them."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm.cli.main import app
from fullswarm.errors import ConfigError
from fullswarm.operator.console.tokens import PASS_S, Admitted, Doorkeeper, TokenFile

OWN = "a-token-of-24-characters"
NOW_S = 1.7e9


class Wall:
    """A wall clock that is set."""

    def __init__(self) -> None:
        self.time_s = NOW_S

    def __call__(self) -> float:
        return self.time_s


@pytest.fixture
def wall() -> Wall:
    return Wall()


@pytest.fixture
def file(tmp_path: Path) -> TokenFile:
    return TokenFile(tmp_path / "config" / "tokens.json")


def admitted(keeper: Doorkeeper, token: str) -> Admitted:
    found = keeper.admit(token)
    assert found is not None
    return found


def test_one_token_for_all_and_a_pass_for_it(wall: Wall) -> None:
    keeper = Doorkeeper(OWN, wall)
    page = admitted(keeper, OWN)
    assert (page.name, page.role) == ("", "operator")
    for wrong in ("", OWN[:-1], OWN + "x", OWN.upper(), "é", "pass.", f"pass.{int(NOW_S) + 10}.{'0' * 64}"):
        assert keeper.admit(wrong) is None
    given = keeper.issue(page)
    assert OWN not in given
    # A console that was started again with the same token knows it; one with another token does not.
    assert Doorkeeper(OWN, wall).admit(given) == page
    assert Doorkeeper("another-token-0123456789", wall).admit(given) is None
    until_s, signature = given.split(".")[1:]
    assert keeper.admit(f"pass.{int(until_s) + 1}.{signature}") is None
    wall.time_s += PASS_S - 1.0
    assert keeper.admit(given) == page
    later = keeper.issue(page)
    wall.time_s += 2.0
    assert keeper.admit(given) is None
    assert keeper.admit(later) == page


def test_name_is_in_the_token_and_its_file_has_none_of_them(wall: Wall, file: TokenFile) -> None:
    anna, ben = file.add("anna", "operator", NOW_S), file.add("ben@lab", "observer", NOW_S)
    text = file.path.read_text()
    assert anna not in text
    assert ben not in text
    assert stat.S_IMODE(file.path.stat().st_mode) == 0o600
    keeper = Doorkeeper("", wall, file=file)
    assert keeper.admit("") is None
    for token, name, role in ((anna, "anna", "operator"), (ben, "ben@lab", "observer")):
        page = admitted(keeper, token)
        assert (page.name, page.role) == (name, role)
        assert keeper.admit(keeper.issue(page)) == page


def test_revoked_and_replaced_tokens_end_with_their_passes_at_once(wall: Wall, file: TokenFile) -> None:
    other = TokenFile(file.path)  # of the command beside a running console
    first, ben = other.add("anna", "operator", NOW_S), other.add("ben", "operator", NOW_S)
    keeper = Doorkeeper("", wall, file=file)
    page, bens = admitted(keeper, first), admitted(keeper, ben)
    given = keeper.issue(page)
    second = other.add("anna", "operator", NOW_S)
    assert not keeper.holds(page)
    assert keeper.admit(first) is keeper.admit(given) is None
    page = admitted(keeper, second)
    given = keeper.issue(page)
    other.revoke("anna")
    assert not keeper.holds(page)
    assert keeper.admit(second) is keeper.admit(given) is None
    assert keeper.holds(bens)
    with pytest.raises(ConfigError, match="no operator 'anna' has a token"):
        other.revoke("anna")


def test_role_that_changes_ends_what_was_allowed_before(wall: Wall, file: TokenFile) -> None:
    keeper = Doorkeeper("", wall, file=file)
    page = admitted(keeper, file.add("anna", "operator", NOW_S))
    given = keeper.issue(page)
    file.add("anna", "observer", NOW_S)
    assert keeper.admit(given) is None
    assert not keeper.holds(page)


def test_token_ends_after_its_days_and_a_page_does_not_outlast_it(wall: Wall, file: TokenFile) -> None:
    token = file.add("anna", "operator", NOW_S, days=0.1)
    keeper = Doorkeeper("", wall, file=file)
    page = admitted(keeper, token)
    given = keeper.issue(page)
    assert keeper.holds(page)
    wall.time_s += 0.1 * 86400.0
    assert not keeper.holds(page)
    assert keeper.admit(token) is keeper.admit(given) is None


def test_token_for_once_works_once_and_its_pass_goes_on(wall: Wall, file: TokenFile) -> None:
    token = file.add("anna", "operator", NOW_S, once=True)
    keeper = Doorkeeper("", wall, file=file)
    page = admitted(keeper, token)
    given = keeper.issue(page)
    assert keeper.admit(token) is None
    assert Doorkeeper("", wall, file=TokenFile(file.path)).admit(token) is None
    assert keeper.admit(given) == page
    assert keeper.holds(page)


def test_file_that_others_can_read_or_that_is_damaged_lets_nobody_in(wall: Wall, file: TokenFile) -> None:
    token = file.add("anna", "operator", NOW_S)
    keeper = Doorkeeper("", wall, file=file)
    page = admitted(keeper, token)
    file.path.chmod(0o640)
    file.path.write_text(file.path.read_text() + " ")
    assert keeper.admit(token) is None
    with pytest.raises(ConfigError, match="other users can read this secret"):
        file.tokens()
    file.path.chmod(0o600)
    assert admitted(keeper, token) == page
    file.path.write_text("[")
    assert keeper.admit(token) is None
    assert not keeper.holds(page)
    with pytest.raises(ConfigError, match="cannot be read"):
        file.tokens()
    file.path.unlink()
    assert keeper.admit(token) is None


@pytest.mark.parametrize("name", ["", "a b", "../x", "a" * 65, "-x", "a\n", "é"])
def test_names_that_are_none(file: TokenFile, name: str) -> None:
    with pytest.raises(ConfigError, match="cannot name an operator"):
        file.add(name, "operator", NOW_S)


def test_commands_add_list_and_revoke(tmp_path: Path) -> None:
    path = str(tmp_path / "tokens.json")

    def run(*words: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["console", "tokens", *words, "--tokens", path])
        return result.exit_code, result.stdout

    code, out = run("add", "anna")
    assert code == 0
    assert out.startswith("#token=")
    assert run("add", "ben", "--observer", "--days", "2", "--once")[0] == 0
    code, out = run("list")
    assert code == 0
    assert "anna" in out
    assert "observer" in out
    assert run("revoke", "anna") == (0, "")
    assert run("revoke", "anna")[0] == 2
    assert "anna" not in run("list", "--json")[1]
    wrong = CliRunner().invoke(app, ["console", "--read-only", "tokens", "list"])
    assert wrong.exit_code == 2
    both = CliRunner().invoke(app, ["console", "--tokens", path, "--operator", "anna"])
    assert both.exit_code == 2


def test_commands_for_programs_have_a_file_of_their_own_and_an_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))

    def run(*words: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["console", "tokens", *words])
        return result.exit_code, result.stdout

    code, out = run("add", "arm1", "--api", "--driver")
    assert (code, len(out.strip())) == (0, 32)
    assert run("add", "anna")[0] == 0
    file = tmp_path / "fullswarm" / "api-tokens.json"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    (token,) = TokenFile(file).tokens()
    assert (token.name, token.role) == ("arm1", "driver")
    assert token.expires_s == pytest.approx(token.issued_s + 90 * 86400.0)
    listed = run("list", "--api", "--json")[1]
    assert ("arm1" in listed, "anna" in listed) == (True, False)
    assert run("add", "arm2", "--api", "--once")[0] == 2
    assert run("add", "arm2", "--driver", "--observer")[0] == 2
    assert run("revoke", "arm1")[0] == 2  # it is no token of a page
    assert run("revoke", "arm1", "--api")[0] == 0
    study = CliRunner().invoke(app, ["console", "--api", "--study", str(tmp_path)])
    assert study.exit_code == 2
