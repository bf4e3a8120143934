"""A folder of tiny wheels that stand for fullswarm's requirements: whole bundles without a package index.

Only the insides of wheels are made up. Names, bounds, tags, the resolver, the installer and all of `bundle` are real.
"""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

from fullswarm.deploy.release.packages import package_name, requirements

MACHINES = {"aarch64": 183, "x86_64": 62}
NATIVE = ("eclipse-zenoh", "msgspec", "numpy")
TAG = "cp311-cp311-manylinux_2_28_{arch}"


def elf(arch: str) -> bytes:
    """Return the first bytes of a 64-bit library for a processor."""
    return b"\x7fELF\x02\x01\x01" + bytes(9) + struct.pack("<HH", 3, MACHINES[arch]) + bytes(44)


def wheel(
    folder: Path, name: str, version: str, *, requires: tuple[str, ...] = (), arch: str = "", lib: str = ""
) -> Path:
    """Write a wheel: pure, or with `arch` one for that processor, holding a library for `lib` (default: `arch`)."""
    module = name.replace("-", "_")
    tag = TAG.format(arch=arch) if arch else "py3-none-any"
    info = f"{module}-{version}.dist-info"
    needs = "".join(f"Requires-Dist: {each}\n" for each in requires)
    content: dict[str, str | bytes] = {
        f"{module}/__init__.py": f"VERSION = {version!r}\n",
        f"{module}/tests/test_it.py": "assert True\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{needs}",
        f"{info}/WHEEL": f"Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: {not arch}\nTag: {tag}\n",
    }
    if arch:
        content[f"{module}/core.so"] = elf(lib or arch)
    content[f"{info}/RECORD"] = "".join(f"{path},,\n" for path in [*content, f"{info}/RECORD"])
    path = folder / f"{module}-{version}-{tag}.whl"
    with zipfile.ZipFile(path, "w") as file:
        for place, text in content.items():
            file.writestr(place, text)
    return path


def fill(folder: Path, *, version: str = "90.0", extras: tuple[str, ...] = (), arch: str = "aarch64") -> Path:
    """Write a wheel of `version` for each thing that fullswarm requires, with some extras; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    needs = requirements()
    for each in [*needs.always, *(line for extra in extras for line in needs.extras[extra])]:
        name = package_name(each)
        wheel(folder, name, version, arch=arch if name in NATIVE else "")
    return folder


def small_fullswarm(folder: Path) -> Path:
    """Write a package of a few files that stands for fullswarm's own code, which may change while a test runs."""
    own_files = {
        "__init__.py": "",
        "agent/node.py": "RATE_HZ = 20\n",
        "core/behaviours.toml": "[idle]\n",
        "testing/suite.py": "",
        "operator/console/page/index.html": "<html>",
        "agent/__pycache__/node.cpython-311.pyc": "x",
        "agent/node.py.orig": "",
        "agent/README.md": "# notes",
        "agent/.node.py.swp": "",
        "deploy/robot/support_package.py": "",
        "deploy/robot/install.sh": "#!/bin/sh\n",
        "deploy/robot/agent.service": "[Unit]\n",
    }
    for path, text in own_files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    return folder
