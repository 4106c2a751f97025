"""The wheel: its metadata, its commands, and the files inside."""

from __future__ import annotations

import re
import subprocess
import sys
from configparser import ConfigParser
from email import message_from_bytes
from email.message import Message
from pathlib import Path
from zipfile import ZipFile

import pytest

from lanestream import __version__

ROOT = Path(__file__).parents[2]
PACKAGES = {"lanestream": "service", "lanestream_client": "client", "lanestream_exporter": "exporter"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=60)
    return ZipFile(next(folder.glob("*.whl")))


@pytest.fixture(scope="module")
def metadata(wheel: ZipFile) -> Message:
    return message_from_bytes(wheel.read(f"lanestream-{__version__}.dist-info/METADATA"))


def test_the_metadata_are_complete(metadata: Message) -> None:
    assert metadata["Name"] == "lanestream"
    assert metadata["Version"] == __version__
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Author"]
    urls = dict(url.split(", ") for url in metadata.get_all("Project-URL") or ())
    assert set(urls) == {"Homepage", "Documentation", "Source", "Issues", "Changelog"}
    classifiers = metadata.get_all("Classifier") or []
    assert "Typing :: Typed" in classifiers
    assert not any(each.startswith("License") for each in classifiers), "the SPDX expression says it"


def test_links_of_the_description_work_outside_the_repository(metadata: Message) -> None:
    payload = metadata.get_payload(decode=True)
    assert isinstance(payload, bytes)
    text = re.sub(r"^```.*?^```", "", payload.decode(), flags=re.DOTALL | re.MULTILINE)
    targets = re.findall(r'(?:\]\(|(?:src|srcset|href)=")([^)"\s]+)', text)
    assert targets
    for target in targets:
        assert re.match(r"https?://|#", target), f"{target} is relative"
        if target.startswith("https://raw.githubusercontent.com/lanestream/lanestream/main/"):
            assert (ROOT / target.split("/main/")[1]).is_file()


def test_the_commands_are_announced(wheel: ZipFile) -> None:
    parser = ConfigParser()
    parser.read_string(wheel.read(f"lanestream-{__version__}.dist-info/entry_points.txt").decode())
    assert parser["console_scripts"]["lanestream"] == "lanestream.cli:main"
    assert set(parser["lanestream.commands"]) == {"client", "exporter"}


def test_all_files_of_the_packages_are_inside(wheel: ZipFile) -> None:
    expected = {
        path.relative_to(ROOT / folder).as_posix()
        for package, folder in PACKAGES.items()
        for path in (ROOT / folder / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert expected - names == set()
    assert {"lanestream/models/classifier.onnx", "lanestream_exporter/configs/datasets.toml"} <= names
    assert {name.partition("/")[0] for name in names} == set(PACKAGES)
