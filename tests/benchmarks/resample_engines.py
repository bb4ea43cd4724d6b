"""Ways of summing sixteen weighted rows of a table: what embedding_bag was chosen from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

Engine = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], Any]


def _bag(table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor, _apart: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.embedding_bag(index, table, per_sample_weights=weight, mode="sum")


def _two_stage(table: torch.Tensor, index: torch.Tensor, _weight: torch.Tensor, apart: torch.Tensor) -> torch.Tensor:
    across = apart[1].T.repeat_interleave(4, dim=0)
    lines = torch.nn.functional.embedding_bag(index.view(-1, 4), table, per_sample_weights=across, mode="sum")
    return torch.bmm(apart[0].T[:, None], lines.view(len(index), 4, -1))[:, 0]


def _sparse(table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor, _apart: torch.Tensor) -> torch.Tensor:
    starts = torch.arange(0, index.numel() + 1, 16, dtype=index.dtype)
    size = (len(index), len(table))
    return torch.sparse_csr_tensor(starts, index.view(-1), weight.view(-1), size, check_invariants=False) @ table


def _bmm(table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor, _apart: torch.Tensor) -> torch.Tensor:
    return torch.bmm(weight[:, None], table[index])[:, 0]


def _numpy(table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor, _apart: torch.Tensor) -> NDArray[np.float32]:
    places, weights, values = index.numpy(), weight.numpy(), table.numpy()
    total: NDArray[np.float32] = np.zeros((len(places), values.shape[1]), np.float32)
    for tap in range(places.shape[1]):
        total += np.take(values, places[:, tap], axis=0) * weights[:, tap, None]
    return total


# Each takes the table (row, band), the rows (n, 16), their weights (n, 16), and the weights along both axes (2, 4, n).
ENGINES: dict[str, Engine] = {
    "embedding_bag 16 taps": _bag,
    "4 bags of 4 taps, then 4": _two_stage,
    "sparse matrix": _sparse,
    "gather and bmm": _bmm,
    "numpy by tap": _numpy,
}
