from __future__ import annotations

import webbrowser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from fullswarm.operator.console.serve import RedirectPage

ADDRESS = "http://127.0.0.1:8807/#token=a-secret-of-24-letters</script>"


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """The addresses that browsers were started with."""
    addresses: list[str] = []

    def note(address: str) -> bool:
        addresses.append(address)
        return True

    monkeypatch.setattr(webbrowser, "open", note)
    monkeypatch.setenv("HOME", str(tmp_path))
    return addresses


def test_the_command_line_has_no_token_and_the_file_is_this_users_alone(opened: list[str], tmp_path: Path) -> None:
    redirect = RedirectPage(ADDRESS)
    assert redirect.open()
    (shown,) = opened
    assert "secret" not in shown
    file = Path(unquote(urlsplit(shown).path))
    assert (file.parent, file.name.startswith(".")) == (tmp_path, False)
    assert file.stat().st_mode & 0o777 == 0o600
    page = file.read_text()
    assert 'location.replace("http://127.0.0.1:8807/#token=a-secret-of-24-letters\\u003c/script>")' in page
    assert page.count("</script>") == 1, "the address cannot end the script"
    redirect.close()
    redirect.close()
    assert not file.exists()


def test_a_home_that_cannot_be_written_is_not_needed(
    opened: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "scratch").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "gone"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "scratch"))
    redirect = RedirectPage(ADDRESS)
    assert redirect.open()
    assert [each.suffix for each in (tmp_path / "scratch").iterdir()] == [".html"]
    redirect.close()
    assert list((tmp_path / "scratch").iterdir()) == []


def test_nowhere_to_write_is_no_browser(opened: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "gone"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "gone too"))
    assert not RedirectPage(ADDRESS).open()
    assert opened == []
