"""The process that `tools/compare.py` starts in each checkout: finds the lanes of the frames that arrive on stdin.

python tools/compare_worker.py CPU     CPU: the one processor to run on

A request is a line of JSON and, after it, `size` bytes of an image file. With `detector` it opens a new camera; with
`answer` the reply contains the lanes. A reply is a line of JSON. Only the standard library and `lanestream.local` are
used, with an API that old revisions have too.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path


def peak_rss_mb() -> float:
    """Returns the largest resident memory of this process so far, in MB.

    Not from getrusage, whose maximum includes the parent's memory from before the exec.
    """
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) * 1024 / 1e6


def main(cpu: int) -> None:
    """Answers requests until stdin ends."""
    # Before the imports: OpenCV, onnxruntime and Lanestream choose their threads by the processors they may use.
    os.sched_setaffinity(0, {cpu})
    import lanestream.local

    requests, replies = sys.stdin.buffer, os.fdopen(os.dup(1), "w", encoding="utf-8")
    # Whatever a library prints must not get between the replies.
    os.dup2(2, 1)
    engine = lanestream.local.LocalEngine.load(None, "cpu")
    camera = engine.open_camera()
    for line in requests:
        request = json.loads(line)
        image = requests.read(request["size"])
        if "detector" in request:
            camera = engine.open_camera(detector=request["detector"])
        wall, used = time.perf_counter(), time.process_time()
        message = camera.lanes(image, seq=request["seq"], timestamp=request["timestamp"])
        used, wall = time.process_time() - used, time.perf_counter() - wall
        reply: dict[str, object] = {
            "package": lanestream.__file__,
            # The monotonic clock is the same in all processes of the machine.
            "answered": time.monotonic(),
            "cpu_s": used,
            "wall_s": wall,
            "process_cpu_s": time.process_time(),
            "peak_rss_mb": peak_rss_mb(),
        }
        if request.get("answer"):
            reply["answer"] = message.model_dump(mode="json", include={"width", "lanes"})
        replies.write(json.dumps(reply) + "\n")
        replies.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
