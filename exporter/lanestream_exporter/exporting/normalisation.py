"""What the graph does to pixels before the network sees them: as the network was trained, or it sees another world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import torch
from torch import Tensor

from lanestream_exporter.alexnet import LEAST_CONTRAST

# Means and standard deviations of ImageNet's red, green and blue, from 0 to 1: the usual recipe of torchvision.
_MEANS: Final = (0.485, 0.456, 0.406)
_DEVIATIONS: Final = (0.229, 0.224, 0.225)


def imagenet(images: Tensor) -> Tensor:
    """RGB images (N, H, W, 3) uint8 as torchvision's networks want them: (N, 3, H, W) float."""
    means, deviations = (torch.tensor(values).view(1, 3, 1, 1) for values in (_MEANS, _DEVIATIONS))
    return (images.permute(0, 3, 1, 2).float() / 255.0 - means) / deviations


def contrast(images: Tensor) -> Tensor:
    """The same as `alexnet.normalize`, in fewer passes over the pixels: beside an int8 network each of them counts."""
    told = images[:, ::4].float()
    mean = told.mean(dim=(1, 2, 3), keepdim=True)
    centred = told - mean
    # Runtimes have a fast mean, and a slow norm.
    deviation = torch.sqrt((centred * centred).mean(dim=(1, 2, 3), keepdim=True))
    normalised: Tensor = (images.permute(0, 3, 1, 2).float() - mean) / (deviation + 255.0 * LEAST_CONTRAST)
    return normalised


# "contrast", each picture against its own brightness and contrast, is how this project trains.
NORMALISATIONS: Final[Mapping[str, Callable[[Tensor], Tensor]]] = {"contrast": contrast, "imagenet": imagenet}
