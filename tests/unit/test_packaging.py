"""What packaging states twice is the same: extras, versions, systems, files of containers."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import yaml

import fullswarm

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
PAGE = (ROOT / "docs" / "how-to-install.md").read_text("utf-8")


def test_the_page_names_each_extra_once() -> None:
    table = PAGE[PAGE.index("| extra | brings |") :]
    assert re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE).count("all") == 1
    assert set(re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE)) == set(PROJECT["optional-dependencies"])


def test_all_is_what_the_page_says() -> None:
    (line,) = PROJECT["optional-dependencies"]["all"]
    inside = set(line.removeprefix("fullswarm[").removesuffix("]").split(","))
    outside = {"all", "bench", "clients", "cluster", "dev", "docs", "mlflow", "rerun"}
    assert set(PROJECT["optional-dependencies"]) - inside == outside


def test_the_version_is_one() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert {PROJECT["version"], citation["version"], fullswarm.__version__} == {PROJECT["version"]}
    assert (citation["cff-version"], citation["title"], citation["license"]) == (
        "1.2.0",
        "fullswarm",
        PROJECT["license"],
    )
    assert citation.keys() >= {"message", "authors"}


def test_the_image_is_built_of_files_that_are_there_and_of_extras_that_exist() -> None:
    lines = (ROOT / "Dockerfile").read_text("utf-8").splitlines()
    copied = [
        name for line in lines if line.startswith("COPY ") and "--from" not in line for name in line.split()[1:-1]
    ]
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text("utf-8").splitlines() if line.startswith("!")}
    assert set(copied) == kept
    assert all((ROOT / name).exists() for name in copied)
    (extras,) = [line.partition("=")[2].split(",") for line in lines if line.startswith("ARG EXTRAS=")]
    assert set(extras) <= set(PROJECT["optional-dependencies"])
    assert lines.index("USER swarm") < lines.index('ENTRYPOINT ["fullswarm"]')


def test_the_dev_container_uses_a_target_of_the_makefile() -> None:
    settings = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text("utf-8"))
    (_, target) = settings["postCreateCommand"].split()
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
