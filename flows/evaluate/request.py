"""What `spectralzoom evaluate` is asked to judge, and what of it cannot be."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from models.evaluation.bootstrap import DRAWS
from models.policies.policies import NETWORK_POLICIES, POLICIES
from pipeline.errors import SettingsError
from pipeline.geometry.scan import CostModel

SHARES = (0.05, 0.10, 0.15, 0.20, 0.35)
JUDGED = tuple(name for name in POLICIES if name not in ("mask", *NETWORK_POLICIES))  # these need a file of one's own
USUAL = ("gain", "entropy", "sobel", "random")
COST = CostModel()


@dataclass(frozen=True)
class EvaluateRequest:
    """What to judge and how."""

    dataset: str
    weights: tuple[Path, ...]
    out: Path | None = None
    shares: tuple[float, ...] = SHARES
    policies: tuple[str, ...] = USUAL
    frames: tuple[str, ...] = ()  # all, without one
    scenes: int | None = None  # of the built-in farm
    seed: int = 0
    draws: int = DRAWS
    timed_frames: int = 2
    timed_runs: int = 10  # after warm-ups
    controls: tuple[Path, ...] = ()
    rig: bool = True
    equal_time: bool = False
    pooled: bool = True
    choices: dict[str, Any] = field(default_factory=dict)  # of load_data_set: labels, bands, wavelengths


def checked_request(request: EvaluateRequest) -> EvaluateRequest:
    """Put shares in order and drop what is there anyway.

    Raises
    ------
    SettingsError : a number out of its range, or a policy that cannot be judged; names the flag.
    """
    for share in request.shares:
        if not 0 <= share <= 1:
            raise SettingsError(f"--shares are shares of the seats from 0 to 1 (0.1 is 10 %), got {share:g}")
    for policy in request.policies:
        if policy not in JUDGED and policy != "oracle":
            raise SettingsError(
                f"--policies: {policy!r} is none that can be judged on a data set; choose of {', '.join(JUDGED)}"
            )
    for flag, value, least in (
        ("--seed", request.seed, 0),
        ("--draws", request.draws, 1),
        ("--timed-frames", request.timed_frames, 0),
        ("--timed-runs", request.timed_runs, 1),
    ):
        if value < least:
            raise SettingsError(f"{flag} must be at least {least}, got {value}")
    shares = tuple(sorted({share for share in request.shares if 0 < share < 1}))
    policies = tuple(dict.fromkeys(name for name in request.policies if name != "oracle"))
    return replace(request, shares=shares, policies=policies)
