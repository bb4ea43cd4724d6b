"""Define the receipt of a run: costs against the reference, accuracy, findings, settings and products.

A published receipt is checked against the model, and has its fields in this order in receipt.json. A receipt that was
read is a dictionary with the same keys.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from spectralzoom.flows.settings.values import RASTER
from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.storage.runs import read_run
from spectralzoom.storage.store import damage
from spectralzoom.storage.whole_files import to_json

Receipt = dict[str, Any]
Facts = dict[str, Any]
CAPTURE_COSTS = ("lines", "samples", "capture_s")


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow")


class Saving(_Part):
    """One cost: of the run, of the reference, and their ratio (null if the reference is 0)."""

    done: float
    full: float
    ratio: float | None
    full_is: Literal["measured", "predicted"]


class MultiplyAddsSaving(Saving):
    """Multiply-adds, also split into overview, scores of patches, and full network (detail)."""

    overview: float
    score: float
    detail: float


class CaptureSaving(Saving):
    """Seconds of capture; the reference is every line at the camera's exposure.

    ``uniform`` are the seconds of the cheapest uniform scan with nearly the best score, and ``uniform_scan`` names it.
    Both are missing where the weights have no scan performance table.
    """

    uniform: float | None = None
    uniform_scan: str | None = None


class Savings(_Part):
    """Costs of the run against every line, sample and patch; a raster has no capture."""

    lines: Saving | None = None
    samples: Saving | None = None
    capture_s: CaptureSaving | None = None
    patches: Saving | None = None  # absent for weights without a network that reads patches in full
    multiply_adds: MultiplyAddsSaving


class DataBytes(_Part):
    """Bytes of a run's stores, counted over whole files, and the reference.

    The run's own folder (receipt, report, pictures) does not count.

    The reference is every line at the camera's own exposure as captured (uint16, uncompressed), for a raster every
    pixel as uint16.
    """

    captured: int  # as the camera delivers them, of all passes
    written: int  # stores that were built, including cleared ones, and spools
    kept: int  # its stores with their inputs, but for raw lines that ``keep`` drops
    reference: int


class Score(_Part):
    """Score of one map, 0..1, over the classes of the labels; IoU is null for a class without labels.

    ``false_classes`` are the pixels of mapped classes without labels.
    """

    miou: float | None
    per_class_iou: dict[str, float | None]
    overall_accuracy: float | None = None
    false_classes: dict[str, int] | None = None


class Control(Score):
    """The best uniform scan of the same seconds, captured and read as the survey was, with its costs."""

    scan: str
    capture_s: float
    kept: int  # bytes
    multiply_adds: float


class StageRow(_Part):
    """One stage; figures of a store that was found are null."""

    name: str
    key: str
    state: Literal["ran", "cached"]
    wall_s: float | None = None
    cpu_s: float | None = None
    peak_rss_bytes: int | None = None
    bytes_in: int | None = None
    bytes_out: int | None = None


class ReceiptFields(_Part):
    """All fields of a receipt; those from ``field`` to ``pixels`` are findings, each present only if it applies."""

    warnings: list[str] | None = None  # about the map, whose score then is not predicted
    survey: str
    source: str
    scene: str
    seed: int
    started: str  # ISO 8601, as all times
    finished: str
    acquired: str | None = None  # when the light was captured, by visit or file, which may be long before ``started``
    versions: dict[str, str]
    settings: Facts
    stages: list[StageRow]
    savings: Savings
    data_bytes: DataBytes
    accuracy: Score | None = None  # against labels
    control: Control | None = None  # the best uniform scan of the same seconds
    training_scene: Literal["all", "other pixels"] | None = None  # what of the scene the weights learned from
    effects: list[Facts] | None = None  # of a simulated source, with their bounds
    effects_total: Facts | None = None  # sum of the bounds beside the tolerance, and seconds saved
    field: Facts | None = None  # its size, field of view, ground pixel and range, hectares an hour
    plan: Facts | None = None  # how the fine pass was laid out
    scans: Facts | None = None  # uniform ones by the scan performance table, where there is one
    recording: Facts | None = None  # of recorded sweeps: lines read and recorded, seconds of a camera
    extent: Facts | None = None  # which part of a field with a prior map was captured, and what was expected of it
    signal: Facts | None = None  # of captured spectra: which fraction has saturated bands
    kept: Facts | None = None  # of a uniform scan that is kept and read in part: patches, costs of all
    prior_map: Facts | None = None  # what became of the prior map
    pointing: Facts | None = None  # where the mirror may look beside the plan
    lines: Facts | None = None  # sweeps with lines lost, repeated, out of order or invalid
    areas: dict[str, dict[str, Any]]  # px of each class; ha if a pixel's size is known; place of most
    ground: Facts | None = None  # with a pose or a placed scene: grid, what changed, what is old
    zones: Facts | None = None  # where zones leave something out: what is kept
    plots: list[Facts] | None = None  # where plots are given: ground, classes, confidence of each
    unlike: Facts | None = None  # distances of mean and spectra from the training, where it is unlike that
    expected: Facts | None = None  # mIoU and error of the map by its own probabilities, or why it is not predicted
    pixels: dict[str, int] | None = None  # where some have no value, no reading or no class: how many
    products: dict[str, str]

    @model_validator(mode="after")
    def _is_complete(self) -> ReceiptFields:
        missing = [name for name in CAPTURE_COSTS if self.source != RASTER and getattr(self.savings, name) is None]
        if missing:
            raise ValueError(f"savings.{missing[0]} is missing")
        return self


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
    return check_receipt(found.receipt)


def check_receipt(receipt: Mapping[str, Any]) -> Receipt:
    """Return the receipt if it is complete; ShapeError names the first field that is missing or not valid."""
    try:
        ReceiptFields.model_validate(receipt)
    except ValidationError as error:
        first = error.errors()[0]
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        what = "is missing" if first["type"] == "missing" else f"is not of the design: {first['msg']}"
        raise ShapeError(f"receipt{place} {what}; survey again; gc --damaged removes a damaged run") from None
    return dict(receipt)
