"""Our own detector for single images in LitServe: what a general serving framework achieves with it."""

# Without `from __future__ import annotations`: LitServe reads the annotation of `request` and needs the class itself.

import argparse
import time
from collections.abc import Sequence
from typing import Any, Final

import litserve
import numpy as np
from lanestream.runtime import Provider

from lanestream.detection import Question, Steps, in_one
from lanestream.detection.features import WORKING_WIDTH
from lanestream.engine import load_engine
from lanestream.images.decoding import DecodedImage, ImageLimits, decode_reduced
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.road.results import FrameResult

# LitServe's documentation uses batches of 8 that wait 50 to 100 ms. A shorter wait is better with few clients.
MAX_BATCH_SIZE: Final = 8
BATCH_TIMEOUT_S: Final = 0.01


class LitServeLaneApi(litserve.LitAPI):  # type: ignore[misc]
    """Images in, lanes out. There are no cameras: every image is processed on its own."""

    def __init__(self, provider: Provider) -> None:
        super().__init__(max_batch_size=MAX_BATCH_SIZE, batch_timeout=BATCH_TIMEOUT_S)
        self._provider = provider

    def setup(self, device: str) -> None:  # noqa: ARG002 - LitServe's signature
        """Loads and warms up the networks, in the worker process."""
        self._engine = load_engine(provider=self._provider)

    def decode_request(self, request: litserve.Request) -> DecodedImage:
        """Decodes the image in the form field `image`."""
        return decode_reduced(request["image"].file.read(), ImageLimits(), WORKING_WIDTH)

    def predict(self, images: Sequence[DecodedImage]) -> list[ProcessedFrame]:
        """Finds the lanes in a batch of images."""
        frames = [self._engine.open_session().follow(image.image, 0.0) for image in images]
        return [
            ProcessedFrame.of(image, result, _NO_TIMING)
            for image, result in zip(images, run_batched(frames), strict=True)
        ]

    def encode_response(self, output: ProcessedFrame) -> dict[str, Any]:
        """Returns the message that our service sends, too."""
        return lanes_message(output, seq=0, timestamp=time.monotonic()).model_dump(mode="json")


_NO_TIMING: Final = dict.fromkeys(("decode", "propose", "queue", "infer", "track", "total"), 0.0)


def run_batched(frames: Sequence[Steps[FrameResult]]) -> list[FrameResult]:
    """Returns the results of all frames. Their inputs for the same network are run as one batch."""
    whole = [in_one(steps) for steps in frames]
    results: dict[int, FrameResult] = {}
    pending: dict[int, Question] = {}

    def go(index: int, answer: Any) -> None:
        try:
            pending[index] = whole[index].send(answer)
        except StopIteration as end:
            results[index] = end.value

    for index in range(len(frames)):
        go(index, None)
    while pending:
        network = next(iter(pending.values())).network
        together = {i: pending.pop(i) for i in list(pending) if pending[i].network is network}
        outputs = network.run(np.concatenate([question.inputs for question in together.values()]))
        ends = np.cumsum([len(question.inputs) for question in together.values()])
        for index, answer in zip(together, np.split(outputs, ends[:-1]), strict=True):
            go(index, answer)
    return [results[index] for index in range(len(frames))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--provider", required=True)
    options = parser.parse_args()
    server = litserve.LitServer(LitServeLaneApi(options.provider), accelerator="cpu", devices=1, timeout=120)
    server.run(host="127.0.0.1", port=options.port, log_level="warning", generate_client_file=False)
