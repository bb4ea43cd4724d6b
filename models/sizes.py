"""Sizes of a segmenter: everything needed to build it again, and to count what it costs, without building it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from pipeline.errors import ShapeError

Positions = Literal["2d", "paper"]

MOST_CLASSES = 255  # maps are uint8 and 255 stands for unlabelled
BOTTOM = 4  # pixels a side at the lowest level of a patch


def level_widths(width: int, patch: int) -> list[int]:
    """Channels of each level, from full patch resolution down to ``BOTTOM`` px: width, 2 width, then 3 width."""
    levels = (patch // BOTTOM).bit_length()
    if patch < BOTTOM or patch != BOTTOM << (levels - 1):
        raise ShapeError(f"a patch must be {BOTTOM} px times a power of two, got {patch}; choose 8, 16 or 32")
    return [width * min(level + 1, 3) for level in range(levels)]


@dataclass(frozen=True)
class SegmenterConfig:
    """Sizes of a segmenter; everything needed to build it again. Raises ShapeError for sizes that do not fit."""

    classes: int
    columns: int = 24
    patch: int = 16
    factor: int = 4
    width: int = 32
    dim: int = 128
    layers: int = 4
    heads: int = 4
    mlp_ratio: int = 3
    positions: Positions = "2d"

    def __post_init__(self) -> None:
        if not 2 <= self.classes <= MOST_CLASSES:
            raise ShapeError(f"a segmenter needs 2 to {MOST_CLASSES} classes, got {self.classes}")
        for name in ("columns", "patch", "factor", "width", "dim", "layers", "heads", "mlp_ratio"):
            if getattr(self, name) < 1:
                raise ShapeError(f"{name} of a segmenter must be at least 1, got {getattr(self, name)}")
        level_widths(self.width, self.patch)  # refuses a patch that cannot be halved down to the lowest level
        if self.patch % self.factor:
            raise ShapeError(f"patch {self.patch} must divide by the factor {self.factor}")
        if self.dim % 4 or self.dim % self.heads:
            raise ShapeError(f"token width {self.dim} must divide by 4 and by its {self.heads} heads")

    def as_dict(self) -> dict[str, int | str]:
        """Plain values for a checkpoint."""
        return asdict(self)
