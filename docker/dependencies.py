"""Fills the image's environment: `dependencies.py ENVIRONMENT EXTRA...`, next to the product's pyproject.toml.

Installs the requirements of the product and its extras, and removes files that the service never uses.
"""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

# Packages contain their tests, and OpenVINO has plugins for Intel's GPUs and NPUs, which a container has no access to.
UNUSED_FILES = ("**/tests", "openvino/libs/libopenvino_intel_[gn]pu_plugin.so")


def requirements(project: Path, extras: list[str]) -> list[str]:
    """Returns the product's requirements with these extras. Raises KeyError for an unknown extra."""
    table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    return [*table["dependencies"], *(line for extra in extras for line in table["optional-dependencies"][extra])]


def prune(packages: Path) -> None:
    """Removes UNUSED_FILES from a folder of installed packages."""
    for path in [path for pattern in UNUSED_FILES for path in packages.glob(pattern)]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def main(environment: Path, extras: list[str]) -> None:
    """Installs the requirements and removes unused files."""
    pip = [sys.executable, "-m", "pip", "--python", environment / "bin/python"]
    subprocess.run([*pip, "install", *requirements(Path("pyproject.toml"), extras)], check=True)
    for packages in environment.glob("lib/python*/site-packages"):
        prune(packages)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
