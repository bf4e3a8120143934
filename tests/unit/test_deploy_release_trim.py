"""What stays on board and what does not."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.deploy.release.contents import needed, trim


@pytest.mark.parametrize(
    "path",
    [
        ".lock",
        "bin/pyserial-miniterm",
        "numpy/_core/tests/test_array.py",
        "numpy/__init__.pyi",
        "numpy/_core/include/numpy/ndarrayobject.h",
        "numpy/_core/lib/libnpymath.a",
        "numpy/__pycache__/version.cpython-311.pyc",
        "numpy-2.4.6.dist-info/RECORD",
        "numpy-2.4.6.dist-info/direct_url.json",
        "pymavlink/dialects/v10/common.py",
        "pymavlink/dialects/v20/icarous.py",
        "pymavlink/generator/mavgen.py",
        "pygments/lexers/javascript.py",
    ],
)
def test_what_never_runs_on_board_goes(path: str) -> None:
    assert not needed(path)


@pytest.mark.parametrize(
    "path",
    [
        "numpy/testing/__init__.py",
        "numpy/_typing/__init__.py",
        "numpy.libs/libscipy_openblas64_-6bb31eeb.so",
        "zenoh/zenoh.abi3.so",
        "numpy-2.4.6.dist-info/METADATA",
        "numpy-2.4.6.dist-info/entry_points.txt",
        "numpy-2.4.6.dist-info/licenses/LICENSE.txt",
        "numpy-2.4.6.dist-info/licenses/numpy/random/tests/LICENSE.md",
        "serial/tools/list_ports.py",
        "pymavlink/dialects/v20/ardupilotmega.py",
        "pymavlink/dialects/v20/__init__.py",
        "pygments/lexers/_mapping.py",
        "can/interfaces/socketcan/socketcan.py",
    ],
)
def test_what_runs_and_what_the_law_asks_for_stays(path: str) -> None:
    assert needed(path)


def _fill(folder: Path) -> None:
    for name in ("acme/__init__.py", "acme/tests/data.toml", "acme-1.dist-info/RECORD", "bin/acme", ".lock"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("x")


def test_folders_that_are_empty_then_go_too(tmp_path: Path) -> None:
    _fill(tmp_path)
    assert trim(tmp_path) == 4
    assert sorted(each.relative_to(tmp_path).as_posix() for each in tmp_path.rglob("*")) == ["acme", "acme/__init__.py"]


def test_an_outside_package_stays_whole(tmp_path: Path) -> None:
    _fill(tmp_path)
    trim(tmp_path, whole=True)
    files = sorted(each.relative_to(tmp_path).as_posix() for each in tmp_path.rglob("*") if each.is_file())
    assert files == ["acme/__init__.py", "acme/tests/data.toml"]
