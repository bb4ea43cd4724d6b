"""Receipts of an archive's runs, and what two runs of the same seed and settings must agree on in them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from flows.publish.receipt import Receipt, check_receipt
from storage.archive.archive import Archive

# what another run of the same seed has otherwise
OF_ONE_RUN = ("wall_s", "cpu_s", "peak_rss_bytes", "state", "manifest_sha256")


def receipts(out: Path) -> list[Any]:
    """What the runs of an archive say, oldest first."""
    return [check_receipt(json.loads((run / "receipt.json").read_text())) for run in Archive.open(out).runs()]


def comparable(receipt: Receipt) -> dict[str, Any]:
    """Return what two runs of the same seed and settings must agree on.

    Without times, memory, the archive's place, bytes of files that hold times, whether a stage was read or made, hashes
    of manifests (which hold their times), and the addresses of the products (their names stay).
    """
    same = _without(receipt, ("started", "finished", "judged"))
    same["settings"] = _without(receipt["settings"], ("out",))
    same["stages"] = [
        _without(stage, (*OF_ONE_RUN, *(("bytes_out",) if stage["name"] == "evaluate" else ())))
        for stage in receipt["stages"]
    ]
    same["data_bytes"] = {name: receipt["data_bytes"][name] for name in ("captured", "reference")}
    return same | {"products": sorted(receipt["products"])}


def _without(part: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {key: value for key, value in part.items() if key not in set(names)}
