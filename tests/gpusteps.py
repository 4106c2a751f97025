"""Steps of `make gpu-check` that go wrong. They are importable, because each step runs in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from gpu_steps import Plan, Report


def crash(plan: Plan) -> Report:
    os.abort()


def fail(plan: Plan) -> Report:
    raise RuntimeError("the device\nis on fire")


def hang(plan: Plan) -> Report:
    """Hangs, like a process that it has started."""
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    time.sleep(600.0)
    return Report()


def crash_beside_a_child(plan: Plan) -> Report:
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    os.abort()
