"""Lists the commands of this package for `lanestream`, which finds the list by its entry point.

It is data only, so that `lanestream --help` imports no command and works without any extra.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

COMMANDS: Final[Mapping[str, Mapping[str, str]]] = {
    "batch": {
        "target": "lanestream_client.batch.command:batch",
        "extra": "video",
        "help": "Find lanes in archives of videos and images.",
    },
    "detect": {
        "target": "lanestream_client.commands:detect",
        "extra": "video",
        "help": "Find lanes in images.",
    },
    "stream": {
        "target": "lanestream_client.commands:stream",
        "extra": "video",
        "help": "Track the lanes in the frames of one camera.",
    },
}
