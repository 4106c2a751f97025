"""AlexNet in PyTorch: torchvision's topology and key names, plus batch normalization while it trains.

Source: A. Krizhevsky, "One weird trick for parallelizing convolutional neural networks", 2014, the variant that
torchvision ships. The normalization layers have their own keys (`norms.*`, `hidden_norms.*`), so a torchvision
checkpoint loads unchanged, and folding them leaves exactly the plain network.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_linear_bn_eval

from lanestream.errors import CheckpointError
from lanestream.road.appearance import BOUNDARY_KINDS, MARKING_COLORS, MARKING_TYPES
from lanestream_exporter.weight_files import load_state, weights_in

# Added to a patch's contrast (1 is full scale), so that the noise of an empty patch is not amplified to a texture.
LEAST_CONTRAST = 0.03

_CONVOLUTIONS = (0, 3, 6, 8, 10)
_CHANNELS = (64, 192, 384, 256, 256)
_HIDDEN = (1, 4)
_NORMS = ("norms.", "hidden_norms.")
_LAST = "classifier.6."


@dataclass(frozen=True)
class Shape:
    """The size of an AlexNet; by default torchvision's.

    Inputs are `size` x `size` pixels, convolutions have the share `width` of torchvision's channels, and each hidden
    layer has `hidden` units.
    """

    size: int = 224
    width: float = 1.0
    hidden: int = 4096

    @property
    def channels(self) -> tuple[int, ...]:
        """The channels of the five convolutions."""
        return tuple(round(self.width * channels) for channels in _CHANNELS)

    @property
    def features(self) -> int:
        """The number of outputs of the convolutions."""
        side = (self.size - 7) // 4 + 1
        for _ in range(3):
            side = (side - 3) // 2 + 1
        return self.channels[-1] * side**2


# The size of the published network and of torchvision's checkpoints.
FULL = Shape()

# The kinds of a candidate: nothing, or one of BOUNDARY_KINDS.
KINDS = 1 + len(BOUNDARY_KINDS)
OUTPUTS = KINDS + len(MARKING_TYPES) + len(MARKING_COLORS)


@dataclass(frozen=True)
class ClassifierLogits:
    """The classifier's logits by meaning: `kinds` (N, 3), `types` (N, 4) and `colors` (N, 2)."""

    kinds: Tensor
    types: Tensor
    colors: Tensor

    @classmethod
    def of(cls, logits: Tensor) -> ClassifierLogits:
        """Returns the parts of logits (N, OUTPUTS)."""
        return cls(*torch.split(logits, [KINDS, len(MARKING_TYPES), len(MARKING_COLORS)], dim=1))


class AlexNet(nn.Module):
    """The network with `outputs` outputs; `batch_norm` adds a batch normalization after each layer but the last.

    Without normalization most hidden units die in the first hundred steps.
    """

    def __init__(
        self, outputs: int = OUTPUTS, shape: Shape = FULL, *, batch_norm: bool = True, dropout: float = 0.5
    ) -> None:
        super().__init__()
        self.shape = shape
        first, second, third, fourth, last = shape.channels
        self.features = nn.Sequential(
            nn.Conv2d(3, first, 11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(first, second, 5, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(second, third, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(third, fourth, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(fourth, last, 3, padding=1),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
        )
        self.norms = nn.ModuleDict(
            {str(i): nn.BatchNorm2d(self._convolution(i).out_channels) for i in _CONVOLUTIONS} if batch_norm else {}
        )
        self.hidden_norms = nn.ModuleDict({str(i): nn.BatchNorm1d(shape.hidden) for i in _HIDDEN} if batch_norm else {})
        self.classifier = nn.Sequential(
            nn.Dropout(dropout),
            nn.Linear(shape.features, shape.hidden),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(shape.hidden, shape.hidden),
            nn.ReLU(),
            nn.Linear(shape.hidden, outputs),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Returns logits (N, outputs) of normalized RGB images (N, 3, size, size)."""
        for index, layer in enumerate(self.features):
            x = layer(x)
            if str(index) in self.norms:
                x = self.norms[str(index)](x)
        x = torch.flatten(x, 1)
        for index, layer in enumerate(self.classifier):
            x = layer(x)
            if str(index) in self.hidden_norms:
                x = self.hidden_norms[str(index)](x)
        return x

    def _convolution(self, index: int) -> nn.Conv2d:
        layer = self.features[index]
        assert isinstance(layer, nn.Conv2d)  # noqa: S101 - for mypy: the constructor guarantees it
        return layer

    def folded(self) -> AlexNet:
        """Returns the same function as a plain AlexNet: each normalization is folded into the layer before it."""
        plain = AlexNet(self.outputs, self.shape, batch_norm=False)
        plain.load_state_dict({k: v.clone() for k, v in self.state_dict().items() if not k.startswith(_NORMS)})
        for key, norm in self.norms.items():
            assert isinstance(norm, nn.BatchNorm2d)  # noqa: S101 - as above
            convolution = plain._convolution(int(key))
            variance, mean = norm.running_var, norm.running_mean
            assert variance is not None and mean is not None and convolution.bias is not None  # noqa: S101, PT018
            gain = norm.weight / torch.sqrt(variance + norm.eps)
            convolution.weight.data = convolution.weight.data * gain[:, None, None, None]
            convolution.bias.data = (convolution.bias.data - mean) * gain + norm.bias
        for key, norm in self.hidden_norms.items():
            hidden = plain.classifier[int(key)]
            assert isinstance(hidden, nn.Linear) and isinstance(norm, nn.BatchNorm1d)  # noqa: S101, PT018 - as above
            plain.classifier[int(key)] = fuse_linear_bn_eval(hidden.eval(), norm.eval())
        return plain.eval()

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        last = self.classifier[6]
        assert isinstance(last, nn.Linear)  # noqa: S101 - as above
        return last.out_features


def normalize(patches: Tensor) -> Tensor:
    """Returns RGB patches (N, H, W, 3) uint8 as network inputs (N, 3, H, W) float.

    Each patch is normalized by its own brightness and contrast, so that a road in the shade looks like one in the sun.
    The channels share both numbers, so that yellow stays yellow. Every fourth row is enough to estimate them.
    """
    images = patches.permute(0, 3, 1, 2).float() / 255.0
    rows = images[:, :, ::4]
    mean = rows.mean(dim=(1, 2, 3), keepdim=True)
    deviation = torch.sqrt(((rows - mean) ** 2).mean(dim=(1, 2, 3), keepdim=True))
    return (images - mean) / (deviation + LEAST_CONTRAST)


def load_torchvision_weights(network: AlexNet, weights: Path) -> None:
    """Loads the convolutions and hidden layers of a torchvision AlexNet checkpoint; the last layer stays random.

    Normalization layers are loaded too if the checkpoint has them. Raises CheckpointError if the file is not such a
    checkpoint, or if the network has another size.
    """
    state = weights_in(load_state(weights))
    has_norms = any(key.startswith(_NORMS) for key in state)
    left_out = (_LAST,) if has_norms else (_LAST, *_NORMS)
    wanted = {k: v for k, v in network.state_dict().items() if not k.startswith(left_out)}
    wrong = [key for key, value in wanted.items() if key not in state or state[key].shape != value.shape]
    if wrong and network.shape != FULL:
        full = "set " + ", ".join(f"{key} = {value}" for key, value in asdict(FULL).items())
        raise CheckpointError(
            f"{weights} is not a checkpoint of a run, and the network is smaller than torchvision's", full
        )
    if wrong:
        raise CheckpointError(f"{weights} lacks {wrong[0]} of a torchvision AlexNet", "give its weights")
    network.load_state_dict({key: state[key] for key in wanted}, strict=False)
