"""An evaluation that several tests share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from spectralzoom.flows.evaluate.command import evaluate_weights
from spectralzoom.flows.settings.model_flags import EvaluateFlags
from tests.flows.small_fields import QUICK, write_weights

Judged = tuple[EvaluateFlags, dict[str, Any]]


@pytest.fixture(scope="package")
def judged(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Judged:
    """Return flags and their evaluation with the weights of two seeds."""
    folder = tmp_path_factory.mktemp("out")
    weights = tuple(write_weights(folder / f"w{seed}.safetensors", seed) for seed in (0, 1))
    flags = EvaluateFlags(weights=weights, out=folder / "out", **QUICK)
    return flags, evaluate_weights(str(data), flags)
