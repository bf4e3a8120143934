"""Files that come with the package, by name; or the user's own, by path."""

from __future__ import annotations

from importlib.resources.abc import Traversable
from pathlib import Path

from fullswarm.errors import ConfigError, did_you_mean


def package_names(folder: Traversable) -> tuple[str, ...]:
    """Return the names of the TOML files in a folder of the package, without their ending."""
    return tuple(sorted(each.name.removesuffix(".toml") for each in folder.iterdir() if each.name.endswith(".toml")))


def read_named(name_or_path: str | Path, folder: Traversable, kind: str) -> tuple[str, str]:
    """Return the text of a file of the package, by its name, or of one by its path; and how to call it in errors.

    Raises
    ------
    ConfigError
        No such file; `kind` says what was looked for.
    """
    text, names = str(name_or_path), package_names(folder)
    if isinstance(name_or_path, str) and text in names:
        return folder.joinpath(f"{text}.toml").read_text("utf-8"), f"{text}.toml"
    if isinstance(name_or_path, str) and not text.endswith(".toml") and "/" not in text:
        raise ConfigError(f"there is no {kind} '{text}'", hint=did_you_mean(text, names))
    try:
        return Path(name_or_path).read_text("utf-8"), text
    except OSError as error:
        raise ConfigError(
            f"cannot read the {kind}: {error.strerror or error}",
            where=text,
            hint=f"or use one by name: {', '.join(names)}",
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"the {kind} is not UTF-8 text", where=text) from error
