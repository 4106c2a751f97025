"""Finding lane boundaries in one frame.

A detector splits its work in two, so that the network between the halves can be shared by many cameras: `prepare`
makes network inputs from an image, `finish` makes detections from the network's outputs. What a frame asks networks is
told by generators, `Steps`: they yield questions and are sent the answers, and know nothing of batches and threads.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import NoDetectorError
from lanestream.protocol import DetectorName
from lanestream.road.curve import Curve
from lanestream.road.results import Candidate, Detection
from lanestream.road.view import Image, RoadView

if TYPE_CHECKING:
    from lanestream.detection.ego_prior import EgoPrior, EgoPriorEstimator
    from lanestream.detection.proposals import Survey

T = TypeVar("T")
U = TypeVar("U")


@dataclass(frozen=True)
class Prepared:
    """A frame on its way through a detector: network inputs, and what `finish` needs again.

    The inputs (N, H, W, 3) uint8 are made `parts` by part, so that a network can be at work on one while the next is
    made; `inputs` are all of them. `view` is the road view that they were made in, and `horizon_weight` (0 to 1) tells
    how much of its horizon was found in this frame. `looks` are the views of the inputs one by one, where each has its
    own. `prior` is what a glance at the frame told; None without one.
    """

    image: Image
    parts: tuple[Callable[[], NDArray[np.uint8]], ...]
    view: RoadView
    candidates: tuple[Candidate, ...] = ()
    horizon_weight: float = 0.0
    looks: tuple[RoadView, ...] = ()
    prior: EgoPrior | None = None

    @cached_property
    def inputs(self) -> NDArray[np.uint8]:
        """All network inputs (N, H, W, 3)."""
        made = [part() for part in self.parts]
        return made[0] if len(made) == 1 else np.concatenate(made)


@dataclass(frozen=True)
class Detections:
    """What a detector found in a frame: boundaries from left to right, and the road view with the horizon it found.

    `horizon_weight` (0 to 1) tells how much the frame had to say about where its horizon is.
    """

    detections: tuple[Detection, ...]
    view: RoadView
    horizon_weight: float


class Detector(Protocol):
    """The two halves of a detector. All is pure and may run in any thread."""

    def survey(self, image: Image, horizon: float | None = None) -> Survey | None:
        """What `prepare` can do of its work before a glance at the frame is answered; None where that is nothing."""
        ...

    def prepare(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),
        prior: EgoPrior | None = None,
        survey: Survey | None = None,
    ) -> Prepared:
        """Network inputs for a BGR image; `horizon` is its row, give or take a nod of the camera, where it is known.

        `expected` are the boundaries of the frame before, in image pixels; `prior` is what a glance at the frame told,
        and `survey` what was found meanwhile, with the same horizon.
        """
        ...

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> Detections:
        """What the network's outputs for `prepared.inputs`, row by row, say of the frame."""
        ...


class Network(Protocol):
    """What runs between the halves: a loaded network."""

    @property
    def name(self) -> str:
        """The model's name and version, for people."""
        ...

    @property
    def provider(self) -> str:
        """The execution provider that really runs it."""
        ...

    @property
    def reason(self) -> str:
        """Why that one."""
        ...

    @property
    def fell_back(self) -> bool:
        """Whether a better one is installed and can't be used."""
        ...

    @property
    def sha256(self) -> str:
        """The SHA-256 of the model file, in hexadecimal digits; empty where nobody looked."""
        ...

    @property
    def buckets(self) -> tuple[int, ...]:
        """The batch sizes that it runs, smaller ones padded; it is best asked no more at a time than the largest."""
        ...

    @property
    def metadata(self) -> dict[str, Any]:
        """What the model file says of itself."""
        ...

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Outputs (N, classes) for inputs (N, H, W, 3) in RGB; N may be 0."""
        ...


@dataclass(frozen=True)
class Question:
    """What is asked of a network: inputs (N, H, W, 3) uint8, N may be 0. The answer is its outputs, row by row.

    Who asks and does not wait goes on with other work, and is sent nothing; the next question to the same network that
    `waits` is sent the outputs of all of them, in order.
    """

    network: Network
    inputs: NDArray[np.uint8]
    waits: bool = True


Steps = Generator[Question, NDArray[np.float32], T]


# What a question is sent that does not wait.
NO_OUTPUTS: Final[NDArray[np.float32]] = np.zeros((0, 0), np.float32)


def in_one(steps: Steps[T]) -> Steps[T]:
    """The same steps for those who answer at once: what was asked in parts is one question."""
    parts = []
    try:
        question = next(steps)
        while True:
            parts.append(question.inputs)
            answer = NO_OUTPUTS
            if question.waits:
                inputs, parts = parts[0] if len(parts) == 1 else np.concatenate(parts), []
                answer = yield Question(question.network, inputs)
            question = steps.send(answer)
    except StopIteration as end:
        value: T = end.value
        return value


def answered(steps: Steps[T]) -> T:
    """What `steps` come to, each question answered at once in the calling thread."""
    whole = in_one(steps)
    try:
        question = next(whole)
        while True:
            question = whole.send(question.network.run(question.inputs))
    except StopIteration as end:
        value: T = end.value
        return value


def beside(steps: Steps[T], work: Callable[[], U]) -> Steps[tuple[T, U]]:
    """The same steps, and what `work` comes to, which is done while the first question is being answered."""
    first = next(steps)
    yield replace(first, waits=False)
    done = work()
    outputs = yield replace(first, inputs=first.inputs[:0])
    try:
        while True:
            outputs = yield steps.send(outputs)
    except StopIteration as end:
        return end.value, done


@dataclass(frozen=True)
class Pipeline:
    """A detector with the network that answers it, by the name that users ask for it.

    A `glance` at the whole road, with a network of its own, tells the detector where to look; it can do without. Of a
    frame whose horizon is not known, `first_look` finds it before all else, where there is one.
    """

    name: DetectorName
    detector: Detector
    network: Network
    glance: EgoPriorEstimator | None = None
    first_look: EgoPriorEstimator | None = None

    def prepare(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),
        glanced: float | None = None,
    ) -> Steps[Prepared]:
        """The detector's first half, after the glance; arguments as for `Detector.prepare`.

        `glanced` is the horizon's row that the glance at the frame before saw. It is steadier than `horizon`, which
        what is found on the road moves about, and a glance at the right place needs no second one.
        """
        if self.first_look is not None and horizon is None:
            horizon = (yield from self.first_look.look(image)).view.horizon
        if self.glance is None:
            return self.detector.prepare(image, horizon, expected)
        looking = self.glance.look(image, horizon if glanced is None else glanced, expected)
        prior, survey = yield from beside(looking, lambda: self.detector.survey(image, horizon))
        prepared = self.detector.prepare(image, horizon, expected, prior, survey)
        return replace(prepared, prior=prior)


def chosen(detectors: Mapping[DetectorName, T], name: DetectorName | None) -> T:
    """What `detectors` has for `name`, its first where None. Raises NoDetectorError where it has nothing."""
    if name is None:
        return next(iter(detectors.values()))
    if name not in detectors:
        raise NoDetectorError(f"there is no detector {name} here", f"ask for {', '.join(detectors)}")
    return detectors[name]
