"""The receipt of a run: what was captured, stored and computed against everything, and what that did to accuracy.

Its fields stand here alone: what is published is checked against the model, and stands in its order in receipt.json. A
receipt that was read is a plain dictionary of the same keys.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from flows.settings.survey_settings import RASTER
from pipeline.errors import ShapeError
from storage.archive.records import StageRecord
from storage.archive.whole_files import to_json

Receipt = dict[str, Any]
AccuracyIs = Literal["judged", "pending", "left out", "without labels"]  # pending: it is worked out after the map
Facts = dict[str, Any]
COSTS = ("lines", "samples", "capture_s", "patches", "multiply_adds")


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow")


class Saving(_Part):
    """One cost: what was spent, what everything costs, their ratio (null where that is 0)."""

    done: float
    full: float
    ratio: float | None
    full_is: Literal["measured", "predicted"]


class MultiplyAddsSaving(Saving):
    """Multiply-adds, also by what they were for: overview, scores, the full network."""

    overview: float
    score: float
    detail: float


class CaptureSaving(Saving):
    """Seconds of capture. Everything is every line at the camera's exposure.

    ``uniform`` are the seconds of the cheapest uniform scan that is nearly as good as any by the weights' record, and
    ``uniform_scan`` names it; both are missing without such a record.
    """

    uniform: float | None = None
    uniform_scan: str | None = None


class Savings(_Part):
    """Costs of the run against every line, sample and patch; of a raster, of which nothing is captured, less."""

    lines: Saving | None = None
    samples: Saving | None = None
    capture_s: CaptureSaving | None = None
    patches: Saving
    multiply_adds: MultiplyAddsSaving


class DataBytes(_Part):
    """Bytes of a run, each counted over whole files and told against ``reference``.

    The reference is every line at the camera's own exposure as it is captured (uint16, uncompressed), of a raster every
    pixel as uint16.
    """

    captured: int  # as the camera delivers them, of all passes
    written: int  # stores that were built, also those cleared since, spools of their lines, and the run's folder
    kept: int  # all files of the archive that the run names or rests on, and its folder
    moved_bucket: int  # to and from a bucket, 0 without one
    moved_workers: int | None  # to workers that share no memory, 0 without any; None: not counted
    reference: int
    reused: dict[str, int]  # of ``kept``, stores that were found and not built, by address


class Score(_Part):
    """Score of one map, 0..1, over the classes of the truth; IoU is null for a class that the truth lacks.

    ``false_classes`` are those that the map shows and the truth lacks, with pixels.
    """

    miou: float | None
    per_class_iou: dict[str, float | None]
    overall_accuracy: float | None = None
    false_classes: dict[str, int] | None = None


class Control(_Part):
    """mIoU of another placement of patches, and its spread over repeats (null where chance has no part)."""

    miou: float | None
    spread: float | None


class Accuracy(Score):
    """Accuracy against labels: this map, no fine patch, every fine patch, and other placements."""

    none: Score
    all: Score
    gap_closed: float | None
    controls: dict[str, Control]


class ReceiptFields(_Part):
    """All fields of a receipt. Those from ``field`` to ``pixels`` are findings, each only where it says something."""

    survey: str
    source: str
    scene: str
    seed: int
    started: str  # ISO 8601, as all times
    finished: str
    versions: dict[str, str]
    settings: Facts
    stages: list[StageRecord]
    savings: Savings
    data_bytes: DataBytes
    accuracy_is: AccuracyIs | None = None
    judged: str | None = None  # when accuracy was added
    accuracy: Accuracy | None = None
    training_scene: Literal["all", "tiles", "other pixels"] | None = None  # what of the scene the weights learned from
    effects: list[Facts] | None = None  # of a simulated source, with their bounds
    effects_total: Facts | None = None  # sum of the bounds beside the tolerance, and seconds saved
    field: Facts | None = None  # its size, field of view, ground pixel and range, hectares an hour
    plan: Facts | None = None  # how the fine pass was laid out
    scans: Facts | None = None  # uniform ones by the scan performance table, where there is one
    recording: Facts | None = None  # of recorded sweeps: lines read and recorded, seconds of a camera
    extent: Facts | None = None  # which part of a field with a prior map was captured, and what was expected of it
    kept: Facts | None = None  # of a uniform scan that is kept and read in part: patches, costs of all
    memory: Facts | None = None  # what became of the prior map
    pointing: Facts | None = None  # where the mirror may look beside the plan
    lines: Facts | None = None  # sweeps with lines lost, repeated, out of order, late or invalid
    areas: Facts | None = None  # px of each class; ha where something says how large a pixel is
    ground: Facts | None = None  # with a pose or a placed scene: grid, what changed, what is old
    zones: Facts | None = None  # where zones leave something out: what is kept
    plots: list[Facts] | None = None  # where plots are given: ground, classes, confidence of each
    unknown: Facts | None = None  # pixels unlike what the weights were trained on
    expected: Facts | None = None  # what the map is likely to score, by its own probabilities; mIoU and error
    pixels: dict[str, int] | None = None  # where some have no value, no reading or no class: how many
    products: dict[str, str]

    @model_validator(mode="after")
    def _is_complete(self) -> ReceiptFields:
        missing = [name for name in COSTS if self.source != RASTER and getattr(self.savings, name) is None]
        if missing:
            raise ValueError(f"savings.{missing[0]} is missing")
        if self.accuracy_is == "judged" and (self.accuracy is None or self.judged is None):
            raise ValueError("accuracy and judged belong to a map that is judged")
        return self


def build_receipt(**fields: object) -> Receipt:
    """Put a receipt together from its fields, in their order; those that are None or empty findings are left out.

    Raises ShapeError: a field is missing, or not of the design; names it.
    """
    needed = {name for name, one in ReceiptFields.model_fields.items() if one.is_required()}
    known = {
        name: fields[name] for name in ReceiptFields.model_fields if fields.get(name) or name in needed & {*fields}
    }
    return check_receipt(json.loads(to_json(known)))


def with_accuracy(
    receipt: Receipt, accuracy: Mapping[str, Any], stage: StageRecord, address: str, *, settings: Facts, judged: str
) -> Receipt:
    """Return the receipt of a run once its map is judged; nothing that was spent on the survey itself changes.

    ``stage`` is the judging's, in the place of an earlier one; ``address`` is of the product ``accuracy``; by
    ``settings`` the map was judged; ``judged`` is when. Raises ShapeError: a field is missing, or not of the design.
    """
    files = {name: place for name, place in receipt["products"].items() if place.startswith("runs/")}
    stores = {name: place for name, place in receipt["products"].items() if name not in (*files, "accuracy")}
    added = {
        **{"accuracy_is": "judged", "judged": judged, "accuracy": accuracy},
        "settings": {**receipt["settings"], **settings},
        "stages": [row for row in receipt["stages"] if row["name"] != stage.name] + [asdict(stage)],
        "products": {**stores, "accuracy": address, **files},
    }
    return build_receipt(**(receipt | added))


def check_receipt(receipt: Mapping[str, Any]) -> Receipt:
    """Return the receipt itself if it has every field of the design; ShapeError naming the first that it lacks."""
    try:
        ReceiptFields.model_validate(receipt)
    except ValidationError as error:
        first = error.errors()[0]
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        what = "is missing" if first["type"] == "missing" else f"is not of the design: {first['msg']}"
        raise ShapeError(f"receipt{place} {what}; survey again, or run verify --repair on the archive") from None
    return dict(receipt)


def is_pending(receipt: Mapping[str, Any]) -> bool:
    """Return whether a run was published before its map was judged, and has not been judged since."""
    return receipt.get("accuracy_is") == "pending"


def hectares_of_classes(receipt: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the hectares of each class, where something says how large a pixel is."""
    areas = receipt.get("areas")
    hectares = areas.get("ha") if isinstance(areas, Mapping) else None
    return hectares if isinstance(hectares, Mapping) else None
