"""Fills the image's environment: `dependencies.py ENVIRONMENT EXTRA...`, beside the product's pyproject.toml.

Installs what the product and its extras require, and takes out what the service never imports.
"""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

# filterpy requires matplotlib, for plots that nobody sees here; the others came with it alone.
UNUSED_PACKAGES = (
    *("matplotlib", "contourpy", "cycler", "fonttools"),
    *("kiwisolver", "pillow", "pyparsing", "python-dateutil"),
)
# Packages bring their tests, and OpenVINO what runs on Intel's GPUs and NPUs, which a container is not given.
UNUSED_FILES = ("**/tests", "openvino/libs/libopenvino_intel_[gn]pu_plugin.so")


def requirements(project: Path, extras: list[str]) -> list[str]:
    """What the product requires with these extras. Raises KeyError where it has no such extra."""
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
    """Installs, and takes out."""
    pip = [sys.executable, "-m", "pip", "--python", environment / "bin/python"]
    subprocess.run([*pip, "install", *requirements(Path("pyproject.toml"), extras)], check=True)
    subprocess.run([*pip, "uninstall", "--yes", *UNUSED_PACKAGES], check=True)
    for packages in environment.glob("lib/python*/site-packages"):
        prune(packages)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
