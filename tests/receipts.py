"""Receipts of an archive's runs, and their parts that two runs of the same seed and settings have in common."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from spectralzoom.flows.publish.receipt import Receipt, check_receipt
from spectralzoom.storage.store import Archive

# differs between runs of the same seed
OF_ONE_RUN = ("wall_s", "cpu_s", "peak_rss_bytes", "state", "manifest_sha256")


def receipts(out: Path) -> list[Any]:
    """Return the checked receipts of an archive's runs, oldest first."""
    return [check_receipt(json.loads((run / "receipt.json").read_text())) for run in Archive.open(out).runs()]


def comparable(receipt: Receipt) -> dict[str, Any]:
    """Return the parts of a receipt that are equal in two runs of the same seed and settings.

    It leaves out times, memory, the archive's path, the states of stages, and bytes of files that contain times.
    Hashes of manifests (which contain times) and addresses of products are left out too; product names stay.
    """
    same = _without(receipt, ("started", "finished"))
    same["settings"] = _without(receipt["settings"], ("out",))
    same["stages"] = [
        _without(stage, (*OF_ONE_RUN, *(("bytes_out",) if stage["name"] == "evaluate" else ())))
        for stage in receipt["stages"]
    ]
    if receipt["effects_total"] is not None:
        same["effects_total"] = _without(receipt["effects_total"], ("saved_s",))
    same["data_bytes"] = {name: receipt["data_bytes"][name] for name in ("captured", "reference")}
    return same | {"products": sorted(receipt["products"])}


def _without(part: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {key: value for key, value in part.items() if key not in set(names)}
