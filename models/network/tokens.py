"""Tokens of both scales in one set, and the codes that tell where each one lies."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from models.network.sizes import Positions as Positions
from pipeline.errors import ShapeError

LONGEST_PERIOD = 128.0  # seats; the shortest is 2


def code_2d(yx: Tensor, dim: int) -> Tensor:
    """Sines and cosines of both coordinates, (..., 2) seats -> (..., dim) float32.

    Angular frequencies run geometrically from pi (period 2 seats) to pi/64. Computed in float64 and cast once: at
    1e7 px the error stays below 1e-6, where float32 angles would be off by half a turn.

    Raises
    ------
    ShapeError : a width that does not divide by 4, or places in half precision.
    """
    if dim % 4:
        raise ShapeError(f"a 2-D code needs a width that divides by 4, got {dim}")
    _check_precision(yx)
    count = dim // 4
    periods = torch.linspace(math.log(2.0), math.log(LONGEST_PERIOD), count, dtype=torch.float64).exp()
    turns = yx.to(torch.float64)[..., None] / periods.to(yx.device)
    angle = 2 * math.pi * (turns - turns.round())
    return torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2).to(torch.float32)


def paper_numbers(yx: Tensor, scale: Tensor, columns: int, factor: int) -> Tensor:
    """One-dimensional positions of the paper: patch n at P = n(m + 1) + 1, its seats at P + 1 ... P + m.

    ``scale`` is above 0 for patches, 0 for seats. ``columns`` counts the coarse patches of a row, m = factor^2; seats
    run row by row inside their patch. The paper's text says jumps of four, its formula and its example 21 -> 26 say
    m + 1 = 5: the formula is taken.
    """
    cell = (yx / factor).floor()
    number = (cell[..., 0] * columns + cell[..., 1]) * (factor**2 + 1) + 1
    inside = (yx - cell * factor).floor()
    seat = inside[..., 0] * factor + inside[..., 1] + 1
    return torch.where(scale > 0, number, number + seat)


def code_1d(position: Tensor, dim: int) -> Tensor:
    """The sinusoids of Vaswani et al. (2017, sec. 3.5) at one number a token, (...) -> (..., dim) float32."""
    _check_precision(position)
    rate = torch.exp(torch.arange(0, dim, 2, dtype=torch.float64) * (-math.log(10000.0) / dim)).to(position.device)
    angle = position.to(torch.float64)[..., None] * rate
    return torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(-2).to(torch.float32)


def _check_precision(places: Tensor) -> None:
    """Refuse half precision: its whole numbers run together above 256 (bfloat16) and 2048 (float16)."""
    if places.dtype in (torch.float16, torch.bfloat16):
        raise ShapeError(f"places of tokens must be float32, float64 or whole numbers, got {places.dtype}")
