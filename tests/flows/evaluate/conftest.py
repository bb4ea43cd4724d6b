"""An evaluation that several tests share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from spectralzoom.flows.evaluate.command import evaluate_weights
from spectralzoom.flows.evaluate.frames import EvaluateRequest
from tests.flows.small_fields import QUICK, write_weights

Judged = tuple[EvaluateRequest, dict[str, Any]]


@pytest.fixture(scope="package")
def judged(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Judged:
    """Return a request and its evaluation with the weights of two seeds."""
    folder = tmp_path_factory.mktemp("out")
    weights = tuple(write_weights(folder / f"w{seed}.safetensors", seed) for seed in (0, 1))
    request = EvaluateRequest(str(data), weights, folder / "out", **QUICK)
    return request, evaluate_weights(request)
