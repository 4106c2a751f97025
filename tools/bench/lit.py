"""LitServe around our own detector, for single images: what one gets who takes a serving framework for it."""

# No `annotations` from the future here: LitServe looks at the annotation of `request` and wants the class itself.

import argparse
import time
from collections.abc import Sequence
from typing import Any, Final

import litserve
import numpy as np

from lanestream.detection import Question, Steps, in_one
from lanestream.detection.features import WORKING_WIDTH
from lanestream.engine import load_engine
from lanestream.images.decoding import ImageLimits, Picture, decode_reduced
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.road.results import FrameResult
from lanestream.runtime import Provider

# LitServe's documentation takes batches of 8 and waits 50 to 100 ms for them; a tenth of that is kinder to few clients.
MOST_IMAGES: Final = 8
WAIT_S: Final = 0.01


class LaneApi(litserve.LitAPI):  # type: ignore[misc]
    """Images in, lanes out: no camera's memory, every image on its own."""

    def __init__(self, provider: Provider) -> None:
        super().__init__(max_batch_size=MOST_IMAGES, batch_timeout=WAIT_S)
        self._provider = provider

    def setup(self, device: str) -> None:  # noqa: ARG002 - LitServe's hook; the provider is ours
        """Loads and warms the networks, in the worker."""
        self._engine = load_engine(provider=self._provider)

    def decode_request(self, request: litserve.Request) -> Picture:
        """The picture of a form."""
        return decode_reduced(request["image"].file.read(), ImageLimits(), WORKING_WIDTH)

    def predict(self, pictures: Sequence[Picture]) -> list[ProcessedFrame]:
        """The lanes of a batch of images."""
        frames = [self._engine.open_session().follow(picture.image, 0.0) for picture in pictures]
        return [
            ProcessedFrame.of(picture, result, _NO_TIMING)
            for picture, result in zip(pictures, in_step(frames), strict=True)
        ]

    def encode_response(self, output: ProcessedFrame) -> dict[str, Any]:
        """The same message as the service's."""
        return lanes_message(output, seq=0, timestamp=time.monotonic()).model_dump(mode="json")


_NO_TIMING: Final = dict.fromkeys(("decode", "propose", "queue", "infer", "track", "total"), 0.0)


def in_step(frames: Sequence[Steps[FrameResult]]) -> list[FrameResult]:
    """The results of all frames, what they ask of one network at a time answered in one run."""
    whole = [in_one(steps) for steps in frames]
    results: dict[int, FrameResult] = {}
    asked: dict[int, Question] = {}

    def go(index: int, answer: Any) -> None:
        try:
            asked[index] = whole[index].send(answer)
        except StopIteration as end:
            results[index] = end.value

    for index in range(len(frames)):
        go(index, None)
    while asked:
        network = next(iter(asked.values())).network
        together = {i: asked.pop(i) for i in list(asked) if asked[i].network is network}
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
    server = litserve.LitServer(LaneApi(options.provider), accelerator="cpu", devices=1, timeout=120)
    server.run(host="127.0.0.1", port=options.port, log_level="warning", generate_client_file=False)
