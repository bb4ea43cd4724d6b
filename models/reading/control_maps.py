"""Use of a trained control on one scene: the map that the two-scale segmenter's is compared with.

What a control costs is counted by ``control_multiply_adds``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from models.network.controls import DenseNetwork, PaperNetwork
from models.network.layers import cut, joined
from models.network.segmenter import Segmenter
from models.network.sizes import PATCHES_AT_ONCE
from models.reading.inference import CoarseLook, DrawnMap, check_seats, decide, draw_coarse, origin_of
from models.weights.files import AnyWeights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid, pad_by_reflection


def draw_with_control(
    weights: AnyWeights, look: CoarseLook, fine: NDArray[np.floating], seats: NDArray[np.integer]
) -> DrawnMap:
    """Draw the class map of a scene, of its own size, with a control.

    ``look`` is the coarse pass in the control's own columns, read by the paper's network and by ``upsampled``. ``fine``
    (seat, p, p, column) are normalised columns of the fine pass; anything not finite counts as the median. ``seats``
    (seat,) are their numbers on the grid, each once: the paper's network reads those that are given, ``dense`` and
    ``coarser`` need every valid seat, ``upsampled`` reads none, whatever is given.

    Raises ShapeError for weights of two scales, a seat missing, given twice or outside the grid, or patches of another
    shape.
    """
    network, numbers = weights.network.eval(), np.ascontiguousarray(seats, np.int64)
    if isinstance(network, Segmenter):
        raise ShapeError("these weights are of two scales; draw with models.reading.inference.segment")
    check_seats(numbers, look.grid)
    with torch.inference_mode():
        if isinstance(network, PaperNetwork):
            coarse = torch.from_numpy(look.columns).permute(2, 0, 1)[None].contiguous()
            logits = network.token_logits(coarse, _tensor(fine)[None], torch.from_numpy(numbers)[None])
            span = look.grid.patch * look.grid.factor
            drawn = draw_coarse(logits, SceneGrid(look.grid.height, look.grid.width, 1, span))
        elif network.config.sight == "halved":
            drawn = _draw_halved(network, look, fine, numbers)
        else:
            drawn = _draw_dense(network, look, fine, numbers)
    return drawn.of_scene(look.grid)


def _draw_dense(
    network: DenseNetwork, look: CoarseLook, fine: NDArray[np.floating], seats: NDArray[np.int64]
) -> DrawnMap:
    """Read every valid seat, from the fine image or from the coarse one brought up; classes decided patch by patch."""
    grid, p = look.grid, look.grid.patch
    y, x = grid.padded_shape
    drawn = DrawnMap(np.empty((y, x), np.uint8), np.empty((y, x), np.float32))
    valid = grid.valid_seats()
    if network.config.sight == "coarse":
        chunks: Iterator[Tensor] = _brought_up(look)
    else:
        chunks = _in_chunks(fine, _places_of(valid, seats))
    corners = iter(grid.seat_origin(valid))
    for logits in _read(network, chunks, -(-grid.width // p), look):
        confidence, classes = decide(logits, dim=1)
        for values, sure in zip(classes.numpy(), confidence.numpy(), strict=True):
            top, left = next(corners)
            drawn.classes[top : top + p, left : left + p] = values
            drawn.confidence[top : top + p, left : left + p] = sure
    return drawn


def _draw_halved(
    network: DenseNetwork, look: CoarseLook, fine: NDArray[np.floating], seats: NDArray[np.int64]
) -> DrawnMap:
    """Read means of 2 x 2 px and bring the map up."""
    grid, p = look.grid, look.grid.patch
    coarser = SceneGrid(grid.height, grid.width, p, 2)
    rows, across = (size // (2 * p) for size in coarser.padded_shape)
    taken = fine[_places_of(grid.valid_seats(), seats)]
    wide = -(-grid.width // p)
    image = taken.reshape(-1, wide, p, p, taken.shape[-1]).swapaxes(1, 2).reshape(-1, wide * p, taken.shape[-1])
    padded = pad_by_reflection(np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0), coarser.padded_shape)
    halved = padded.reshape(rows * p, 2, across * p, 2, -1).astype(np.float32).mean(axis=(1, 3))
    cells = halved.reshape(rows, p, across, p, -1).swapaxes(1, 2).reshape(-1, p, p, halved.shape[-1])
    logits = torch.cat(list(_read(network, _in_chunks(cells, np.arange(len(cells))), across, look)))
    return draw_coarse(joined(logits[None], across), coarser)


def _read(network: DenseNetwork, chunks: Iterator[Tensor], columns: int, look: CoarseLook) -> Iterator[Tensor]:
    """Class logits of all patches, some at a time, in rows of ``columns``; features stay in the caches."""
    described = [network.stem(chunk) for chunk in chunks]
    tokens = torch.cat([token for _, token in described])[None]
    read = network.encode(tokens, columns, origin_of(look))[0]
    parts = torch.split(read, [len(token) for _, token in described])
    for (features, _), token in zip(described, parts, strict=True):
        yield network.decode(features, token)


def _in_chunks(patches: NDArray[np.floating], order: NDArray[np.integer]) -> Iterator[Tensor]:
    for first in range(0, len(order), PATCHES_AT_ONCE):
        yield _tensor(patches[order[first : first + PATCHES_AT_ONCE]])


def _tensor(patches: NDArray[np.floating]) -> Tensor:
    """(patch, y, x, column) -> (patch, column, y, x), what is not finite as the median."""
    finite = np.nan_to_num(np.asarray(patches, np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    return torch.from_numpy(finite).permute(0, 3, 1, 2).contiguous()


def _brought_up(look: CoarseLook) -> Iterator[Tensor]:
    """Patches of the coarse image brought up bilinearly, those of one row of valid seats at a time."""
    grid, s = look.grid, look.grid.factor
    cells = grid.patch // s
    wide, high = -(-grid.width // grid.patch), -(-grid.height // grid.patch)
    image = torch.from_numpy(look.columns).permute(2, 0, 1)[None]
    padded = F.pad(image, (0, 0, 1, 1), mode="replicate")
    for top in range(0, high * cells, cells):
        strip = F.interpolate(
            padded[:, :, top : top + cells + 2].contiguous(), scale_factor=s, mode="bilinear", align_corners=False
        )[:, :, s:-s]
        yield cut(strip, grid.patch)[0, :wide]


def _places_of(valid: NDArray[np.integer], seats: NDArray[np.int64]) -> NDArray[np.intp]:
    """Where each valid seat stands among those given."""
    order = np.argsort(seats, kind="stable")
    found = np.isin(valid, seats)
    if not found.all():
        raise ShapeError(
            f"a dense control reads all {len(valid)} valid seats, {np.count_nonzero(~found)} of them are missing"
        )
    places: NDArray[np.intp] = order[np.searchsorted(seats[order], valid)]
    return places
