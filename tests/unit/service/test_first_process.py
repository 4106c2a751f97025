"""A container's first process is deaf to signals without a handler: SIGTERM would wait for the end of the imports."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

COMMAND = """
import os, signal
from lanestream import cli
os.getpid = lambda: {number}
cli.cli.main = lambda **_: signal.raise_signal(signal.SIGTERM)
cli.main()
"""


@pytest.mark.parametrize(("number", "code"), [(1, 143), (77, -signal.SIGTERM)])
def test_sigterm_ends_what_still_starts_as_the_first_process_too(number: int, code: int) -> None:
    done = subprocess.run([sys.executable, "-c", COMMAND.format(number=number)], check=False)
    assert done.returncode == code
