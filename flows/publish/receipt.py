"""Build and load the receipt of a run, checked against the model of `storage.receipts`.

A published receipt has its fields in the order of the model in receipt.json. A receipt that was read is a dictionary
with the same keys.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spectralzoom.flows.settings.values import RASTER
from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.storage.receipts import ReceiptFields, receipt_problem
from spectralzoom.storage.runs import read_run
from spectralzoom.storage.store import damage
from spectralzoom.storage.whole_files import to_json

Receipt = dict[str, Any]
CAPTURE_COSTS = ("lines", "samples", "capture_s")


def build_receipt(**fields: object) -> Receipt:
    """Return a receipt of these fields, in order, without empty findings.

    Raises ShapeError: a field is missing or not valid.
    """
    needed = {name for name, one in ReceiptFields.model_fields.items() if one.is_required()}
    known = {
        name: fields[name] for name in ReceiptFields.model_fields if fields.get(name) or name in needed & {*fields}
    }
    return check_receipt(json.loads(to_json(known)))


def load_receipt(folder: Path) -> Receipt:
    """Return the receipt of a published run (IncompleteStoreError: it has changed; ShapeError: it is not valid)."""
    found = read_run(folder)
    if found.problem is not None:
        raise damage(folder, found.problem)
    try:
        return check_receipt(found.receipt)
    except ShapeError as error:
        raise ShapeError(f"{folder}: {error}; survey again; gc --damaged removes a damaged run") from None


def check_receipt(receipt: Mapping[str, Any]) -> Receipt:
    """Return the receipt if it is complete; ShapeError names the first key that is missing or not valid."""
    wrong = receipt_problem(receipt, whole=True)
    if wrong is None and receipt["source"] != RASTER:
        missing = [name for name in CAPTURE_COSTS if receipt["savings"].get(name) is None]
        wrong = f"savings.{missing[0]} is missing" if missing else None
    if wrong is not None:
        raise ShapeError(f"receipt.json: {wrong}")
    return dict(receipt)
