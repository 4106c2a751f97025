"""What may happen to a patch between a road and the network, on whole batches.

The first published tracker's list (flip, blur and sharpen, darken, noise) and what cameras do beyond it: exposure,
colour casts, shadow edges, lost pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def augmented(patches: Tensor, generator: torch.Generator) -> Tensor:
    """RGB patches (N, H, W, 3) uint8, each with its own accidents; the same shape and type."""
    images = patches.float() / 255.0
    images = _exposed(_flipped(images, generator), generator)
    images = _shadowed(images, generator)
    images = _blurred(images, generator)
    grain = torch.randn((*images.shape[:3], 1), generator=generator)
    images = images + _uniform(images, generator, 0.0, 0.05) * grain
    return (images.clamp(0.0, 1.0) * 255.0).to(torch.uint8)


def _uniform(images: Tensor, generator: torch.Generator, low: float, high: float, channels: int = 1) -> Tensor:
    """A number per image, or per image and channel, shaped to multiply a batch (N, H, W, 3)."""
    shape = (len(images), 1, 1, channels)
    return low + (high - low) * torch.rand(shape, generator=generator)


def _flipped(images: Tensor, generator: torch.Generator) -> Tensor:
    return torch.where(_uniform(images, generator, 0.0, 1.0) < 0.5, images, images.flip(2))


def _exposed(images: Tensor, generator: torch.Generator) -> Tensor:
    gamma = torch.exp(_uniform(images, generator, -0.4, 0.4))
    gain = torch.exp(_uniform(images, generator, -0.9, 0.4)) * _uniform(images, generator, 0.9, 1.1, channels=3)
    return images.clamp(min=1e-4) ** gamma * gain + _uniform(images, generator, -0.05, 0.08)


def _shadowed(images: Tensor, generator: torch.Generator) -> Tensor:
    """Darkens one side of a random straight edge in a third of the images."""
    _, height, width, _ = images.shape
    turn = _uniform(images, generator, 0.0, 2.0 * torch.pi)
    y = torch.linspace(-1.0, 1.0, height).view(1, height, 1, 1)
    x = torch.linspace(-1.0, 1.0, width).view(1, 1, width, 1)
    side = x * torch.cos(turn) + y * torch.sin(turn) > _uniform(images, generator, -0.8, 0.8)
    shade = torch.where(_uniform(images, generator, 0.0, 1.0) < 0.33, _uniform(images, generator, 0.25, 0.8), 1.0)
    return torch.where(side, images * shade, images)


def _blurred(images: Tensor, generator: torch.Generator) -> Tensor:
    """From a blur to an over-sharpened image: away from or towards the local mean."""
    mean = functional.avg_pool2d(images.permute(0, 3, 1, 2), 3, stride=1, padding=1).permute(0, 2, 3, 1)
    amount = _uniform(images, generator, -0.6, 1.0)
    return images + amount * (mean - images)
