"""Fills the image's environment: `dependencies.py ENVIRONMENT LOCK_FILE`.

Installs the packages of a lock file, and removes files that the service never uses.
"""

import shutil
import subprocess
import sys
from pathlib import Path

# Packages contain their tests, and OpenVINO has plugins for Intel's GPUs and NPUs, which a container has no access to.
UNUSED_FILES = ("**/tests", "openvino/libs/libopenvino_intel_[gn]pu_plugin.so")


def prune(packages: Path) -> None:
    """Removes UNUSED_FILES from a folder of installed packages."""
    for path in [path for pattern in UNUSED_FILES for path in packages.glob(pattern)]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def main(environment: Path, lock_file: Path) -> None:
    """Installs the packages, wheels with the locked hashes only, and removes unused files."""
    pip = [sys.executable, "-m", "pip", "--python", environment / "bin/python"]
    subprocess.run([*pip, "install", "--require-hashes", "--only-binary", ":all:", "-r", lock_file], check=True)
    for packages in environment.glob("lib/python*/site-packages"):
        prune(packages)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
