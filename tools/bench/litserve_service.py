"""Our own detector for single images in LitServe: what a general serving framework achieves with it."""

# Without `from __future__ import annotations`: LitServe reads the annotation of `request` and needs the class itself.

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import litserve
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import ModelRole
from lanestream.engine import load_engine
from lanestream.images.decoding import DecodedImage, ImageLimits, decode_reduced
from lanestream.inference.batcher import Batcher
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.road.view import WORKING_WIDTH
from lanestream.session import SessionOptions

# LitServe's documentation uses batches of 8 that wait 50 to 100 ms. A shorter wait is better with few clients.
MAX_BATCH_SIZE: Final = 8
BATCH_TIMEOUT_S: Final = 0.01


class LitServeLaneApi(litserve.LitAPI):  # type: ignore[misc]
    """Images in, lanes out. There are no cameras: every image is processed on its own."""

    def __init__(self, provider: str) -> None:
        super().__init__(max_batch_size=MAX_BATCH_SIZE, batch_timeout=BATCH_TIMEOUT_S)
        self._provider = provider

    def setup(self, device: str) -> None:  # noqa: ARG002 - LitServe's signature
        """Loads and warms up the networks, in the worker process."""
        self._engine = load_engine(provider=self._provider)
        self._threads = ThreadPoolExecutor(MAX_BATCH_SIZE)
        self._batcher = Batcher()

    def decode_request(self, request: litserve.Request) -> DecodedImage:
        """Decodes the image in the form field `image`."""
        return decode_reduced(request["image"].file.read(), ImageLimits(), WORKING_WIDTH)

    def predict(self, images: Sequence[DecodedImage]) -> list[ProcessedFrame]:
        """Finds the lanes in a batch of images, each in a thread. Their inputs for the same network share batches."""
        return list(self._threads.map(self._process, images))

    def encode_response(self, output: ProcessedFrame) -> dict[str, Any]:
        """Returns the message that our service sends, too."""
        return lanes_message(output, seq=0, timestamp=time.monotonic()).model_dump(mode="json")

    def _process(self, image: DecodedImage) -> ProcessedFrame:
        result = self._engine.open_session(SessionOptions(single_image=True)).process(image.image, 0.0, self._infer)
        return ProcessedFrame.of(image, result, _NO_TIMING)

    def _infer(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._batcher.run(self._engine.models[role], inputs).outputs


_NO_TIMING: Final = dict.fromkeys(("decode", "propose", "queue", "infer", "fit", "track", "total"), 0.0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--provider", required=True)
    options = parser.parse_args()
    server = litserve.LitServer(LitServeLaneApi(options.provider), accelerator="cpu", devices=1, timeout=120)
    server.run(host="127.0.0.1", port=options.port, log_level="warning", generate_client_file=False)
