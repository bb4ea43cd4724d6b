"""Training from weights that exist: they are opened and checked first, and what they have seen is never forgotten."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.training.data import TrainingData, either_mask
from models.network.sizes import Preset, SegmenterConfig
from models.training.start_weights import StartFile
from pipeline.errors import SettingsError, ShapeError

Split = dict[str, Any]


def open_start(init: Path | None, tokens: Mapping[str, Any], preset: Preset) -> StartFile | None:
    """Open the file to begin from; None without one.

    Raises
    ------
    SettingsError : no such file, tokens of other sizes than ``tokens`` and the usual ones, or another network.
    WeightsError : a file of no kind that is known.
    """
    if init is None:
        return None
    if preset != "two-scale":
        raise SettingsError(f"--init is for the two-scale network, got --preset {preset}; leave one of both out")
    start = StartFile(init)
    try:
        start.check(SegmenterConfig(2, **tokens))
    except ShapeError as error:
        raise SettingsError(f"{error}; choose another --dim or --heads") from error
    return start


def refuse_seen(start: StartFile | None, data: TrainingData) -> None:
    """Refuse to validate on scenes that the start was trained on. Raises SettingsError with the first of them."""
    earlier: Split = {} if start is None else start.earlier.get("split", {})
    seen = set(earlier.get("train", {}).values())  # with a mask too: validation counts every labelled pixel
    if start is None or not seen:
        return
    for name, scene in zip(data.validation, data.scenes(data.validation), strict=True):
        if scene.key in seen:
            raise SettingsError(
                f"--init {start.path} was trained on the scene {name}, which is kept for validation here: figures on it"
                " would say nothing; pass --validation 0 and judge on others with evaluate"
            )


def joined_split(split: Split, start: StartFile | None) -> Split:
    """Add what the start was trained on: weights begun from others have seen what these have seen."""
    earlier: Split = {} if start is None else start.earlier.get("split", {})
    if start is None or not earlier.get("train"):
        return split
    own, parts = split["train"], split["pixels"]
    before, parts_before = earlier["train"], earlier.get("pixels", {})
    whole = {key for key in before.values() if key not in parts_before}
    whole |= {key for key in own.values() if key not in parts}
    masks = {key: either_mask(parts.get(key), parts_before.get(key)) for key in parts.keys() | parts_before.keys()}
    more = {f"{start.path.name}: {name}": key for name, key in before.items() if key not in own.values()}
    return split | {"train": own | more, "pixels": {key: mask for key, mask in masks.items() if key not in whole}}


def print_start(begun: Mapping[str, Any], console: Console) -> None:
    """Say what became of the tensors of the file."""
    skipped: Mapping[str, list[str]] = begun["skipped"]
    counts = f"{begun['matched']} tensors matched, {len(begun['resized'])} resized"
    console.print(f"begun from {begun['file']} ({begun['kind']}): {counts}, {sum(map(len, skipped.values()))} skipped")
    for name, how in begun["resized"].items():
        console.print(f"  resized {name}: {how}")
    for why, names in skipped.items():
        shown = f"{names[0]} and {len(names) - 1} more" if len(names) > 1 else names[0]
        console.print(f"  skipped {shown}: {why}")
    if "unsealed" in begun:
        console.print(f"  note: {begun['unsealed']}", highlight=False, markup=False, soft_wrap=True)
    if begun["licence"]:
        console.print(f"  its licence: {begun['licence']}")
