"""Code of others in the page is what its provenance file says it is, and nothing of it is missing there."""

from __future__ import annotations

import hashlib
import re
import tomllib
from pathlib import Path

import fullswarm

PAGE = Path(fullswarm.__file__).parent / "operator" / "console" / "page"
RECORDS = tomllib.loads((PAGE / "vendored.toml").read_text(encoding="utf-8"))


def test_each_file_has_the_hash_of_its_record() -> None:
    for record in RECORDS.values():
        for name, file in record["files"].items():
            assert hashlib.sha256((PAGE / name).read_bytes()).hexdigest() == file["sha256"], name


def test_the_version_is_the_one_that_the_code_states() -> None:
    found = re.search(r"\(v([\d.]+)\)", (PAGE / "uplot.js").read_text(encoding="utf-8"))
    assert found is not None
    assert found.group(1) == RECORDS["uplot"]["version"]


def test_every_file_with_a_foreign_copyright_is_recorded() -> None:
    known = {name for record in RECORDS.values() for name in record["files"]}
    foreign = {
        path.name
        for path in PAGE.iterdir()
        if re.search(r"copyright \(c\)", path.read_text(encoding="utf-8"), re.IGNORECASE)
    }
    assert foreign <= known


def test_every_file_with_the_name_of_a_package_is_recorded() -> None:
    for package, record in RECORDS.items():
        assert {path.name for path in PAGE.glob(f"{package}.*")} == set(record["files"])
