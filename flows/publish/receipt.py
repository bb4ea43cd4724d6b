"""The receipt of a run: what was captured, stored and computed against everything, and what that did to accuracy.

One plain dictionary feeds ``receipt.json``, the terminal's last block (`flows.publish.receipt_table`) and the report.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, NotRequired, TypedDict, cast, get_args

from flows.settings.survey_settings import RASTER
from flows.tasks.scores import JUDGING
from pipeline.errors import ShapeError
from storage.archive.records import StageRecord, State
from storage.archive.whole_files import to_json

AccuracyIs = Literal["judged", "pending", "left out", "without labels"]  # pending: it is worked out after the map


class Saving(TypedDict):
    """One cost: what was spent, what the full scan costs, their ratio (null where full is 0)."""

    done: float
    full: float
    ratio: float | None
    full_is: Literal["measured", "predicted"]


class SecondsSaved(Saving):
    """Seconds of capture: ``full`` is the cheapest scan that is nearly as good as any, by the weights' record.

    Without such a record, and in receipts of before, it is every line at the camera's exposure.
    """

    full_scan: NotRequired[str]  # in words; with a record alone
    every_line_s: NotRequired[float]  # what ``full`` was before; with a record alone, and for one version


class Split(Saving):
    """Multiply-adds, also told apart by what they were for."""

    glance: float
    score: float
    encode: float
    decode: float


class Savings(TypedDict):
    """What the run spent against every line at full resolution; seconds against a scan that is nearly as good.

    Of a raster, of which nothing is captured, against keeping and reading every pixel.
    """

    lines: NotRequired[Saving]
    samples: NotRequired[Saving]
    bytes_raw: NotRequired[Saving]
    bytes_stored: Saving
    capture_s: NotRequired[SecondsSaved]
    tokens: Saving
    multiply_adds: Split
    segment_wall_s: NotRequired[dict[str, float]]


class Score(TypedDict):
    """What one map scores, 0..1, over the classes that the truth has; receipts of before lack some.

    IoU is null for a class that the truth lacks; ``false_classes`` are those of them that the map shows, with pixels.
    """

    miou: float | None
    per_class_iou: dict[str, float | None]
    false_classes: NotRequired[dict[str, int]]
    miou_of_shown_classes: NotRequired[float | None]  # by the definition of before
    overall_accuracy: NotRequired[float | None]


class Control(TypedDict):
    """mIoU of another placement of seats, and its spread over repeats (null where chance has no part)."""

    miou: float | None
    spread: float | None
    miou_of_shown_classes: NotRequired[float | None]
    overall_accuracy: NotRequired[float | None]


class Accuracy(Score):
    """Accuracy against labels: this map, no fine seat, every fine seat, and other placements."""

    none: Score
    all: Score
    gap_closed: float | None
    controls: dict[str, Control]
    confusion: NotRequired[list[list[int]]]  # pixels by label (row) and mapped class; receipts of before have none
    controls_mode: NotRequired[dict[str, Any]]  # seats of the controls, and their share of samples, lines, seconds


class Receipt(TypedDict):
    """Everything that a run has to say for itself; `check_receipt` says whether it is complete."""

    survey: str
    source: str
    scene: str
    seed: int
    started: str
    finished: str
    versions: dict[str, str]
    settings: dict[str, Any]
    stages: list[dict[str, Any]]
    savings: Savings
    accuracy_is: NotRequired[AccuracyIs]  # receipts of before have none
    judged: NotRequired[str]  # when accuracy was added, ISO 8601
    accuracy: NotRequired[Accuracy]
    effects: NotRequired[list[dict[str, Any]]]
    effects_total: NotRequired[dict[str, Any]]  # sum of the bounds beside the tolerance, and seconds saved
    field: NotRequired[dict[str, Any]]  # its size, field of view, ground pixel and range, hectares an hour
    plan: NotRequired[dict[str, Any]]  # how the fine pass was laid out, and what the other orientation would cost
    scans: NotRequired[dict[str, dict[str, Any]]]  # plain ones by the weights' record, where there is one
    recording: NotRequired[dict[str, Any]]  # only of recorded sweeps: lines read and recorded, seconds of a camera
    look: NotRequired[dict[str, Any]]  # which part of a remembered field was looked at, and what was expected of it
    kept: NotRequired[dict[str, Any]]  # only of a plain scan that is kept and read in part: seats, costs of all, asked
    memory: NotRequired[dict[str, Any]]  # what became of what was remembered, where the map goes on from an earlier run
    pointing: NotRequired[dict[str, Any]]  # only where the mirror may look beside the plan
    lines: NotRequired[dict[str, Any]]  # sweeps with lines lost, repeated, out of order, late or invalid
    ground: NotRequired[dict[str, Any]]  # only with a pose or a placed scene: grid, hectares
    zones: NotRequired[dict[str, Any]]  # only where zones leave something out: what is kept
    plots: NotRequired[list[dict[str, Any]]]  # only where plots are given: ground, classes, confidence of each
    unknown: NotRequired[dict[str, Any]]  # pixels unlike what the weights were trained on, where they know what is
    expected: NotRequired[dict[str, Any]]  # what the map is likely to score, by what it says of itself; mIoU and error
    pixels: NotRequired[dict[str, int]]  # only where some have no value, no reading or no class: how many
    products: dict[str, str]


@dataclass(frozen=True)
class Header:
    """Who looked at what, when, with which code and settings. Times are ISO 8601."""

    survey: str
    source: str
    scene: str
    seed: int
    started: str
    finished: str
    versions: Mapping[str, str]
    settings: Mapping[str, object]


COSTS = ("lines", "samples", "bytes_raw", "bytes_stored", "capture_s", "tokens", "multiply_adds")
OF_A_RASTER = ("bytes_stored", "tokens", "multiply_adds")  # of which nothing is captured
FINDINGS = (
    "field",
    "plan",
    "scans",
    "recording",
    "look",
    "kept",
    "memory",
    "pointing",
    "lines",
    "ground",
    "zones",
    "plots",
    "unknown",
    "expected",
    "pixels",
)
_SAVING_FIELDS = ("done", "full", "ratio", "full_is")
_SPLIT_FIELDS = ("glance", "score", "encode", "decode")
_STAGE_FIELDS = ("name", "key", "state", "wall_s", "cpu_s", "peak_rss_bytes", "bytes_in", "bytes_out")
_EFFECT_FIELDS = ("name", "state", "variant", "bound", "measured", "cost_s", "why")
_TOTAL_FIELDS = ("asked", "tolerance", "unit", "bound", "measured", "on", "off", "cost_s", "saved_s", "saved_cheap_s")
_HEADER_FIELDS = ("survey", "source", "scene", "seed", "started", "finished", "versions", "settings")
# what another run of the same seed has otherwise
_OF_ONE_RUN = ("wall_s", "cpu_s", "peak_rss_bytes", "state", "manifest_sha256")


def build_receipt(
    header: Header,
    stages: Iterable[StageRecord],
    savings: Mapping[str, object],
    products: Mapping[str, str],
    *,
    accuracy: Mapping[str, object] | None = None,
    accuracy_is: AccuracyIs | None = None,
    judged: str | None = None,
    simulation: Mapping[str, Any] | None = None,
    findings: Mapping[str, object] | None = None,
) -> Receipt:
    """Put a receipt together in its fixed order and check that nothing is missing (ShapeError names what is).

    ``savings`` are `COSTS`, of a raster `OF_A_RASTER`, and, where measured, ``segment_wall_s``, each with the fields of
    `Saving`. ``accuracy`` has the fields of `Accuracy`, ``judged`` is when it was worked out; None where the map is not
    judged, or not yet: ``accuracy_is`` says which. ``simulation`` has ``effects``, rows with name, state, variant,
    bound, measured, cost_s, why, unit, and ``total``, their sums; None for a source that is not simulated.
    ``findings``: see `FINDINGS`.
    """
    receipt: dict[str, object] = {**asdict(header), "stages": [asdict(stage) for stage in stages]}
    receipt["savings"] = {name: savings[name] for name in (*COSTS, "segment_wall_s") if name in savings}
    told = {"accuracy_is": accuracy_is, "judged": judged, "accuracy": accuracy}
    receipt |= {name: value for name, value in told.items() if value is not None}
    if simulation is not None:
        receipt |= {"effects": list(simulation["effects"]), "effects_total": simulation["total"]}
    receipt |= {name: found for name in FINDINGS if (found := (findings or {}).get(name))}
    receipt["products"] = dict(products)
    return check_receipt(json.loads(to_json(receipt)))


def with_accuracy(
    receipt: Receipt,
    accuracy: Mapping[str, Any],
    stage: StageRecord,
    address: str,
    *,
    settings: Mapping[str, object],
    judged: str,
) -> Receipt:
    """The receipt of a run once its map is judged; nothing that was spent on the survey itself changes.

    ``accuracy`` has the fields of `Accuracy` and, where measured, ``segment_wall_s``, which belongs to the savings.
    ``stage`` is the judging's, in the place of an earlier one; ``address`` is of the product ``accuracy``; by
    ``settings`` the map was judged; ``judged`` is when, ISO 8601. Raises ShapeError: a field is missing, or not of the
    design; names it.
    """
    figures = {name: value for name, value in accuracy.items() if name != "segment_wall_s"}
    walls = {name: accuracy[name] for name in ("segment_wall_s",) if name in accuracy}
    added = {"accuracy_is": "judged", "judged": judged, "accuracy": figures}
    found: dict[str, object] = {}
    for name, value in receipt.items():
        if name not in added:
            found[name] = value
        if name == "savings":  # accuracy follows it
            found |= added
    found["settings"] = {**receipt["settings"], **settings}
    found["stages"] = [*(row for row in receipt["stages"] if row["name"] != stage.name), asdict(stage)]
    found["savings"] = {**receipt["savings"], **walls}
    files = {name: place for name, place in receipt["products"].items() if place.startswith("runs/")}
    stores = {name: place for name, place in receipt["products"].items() if name not in (*files, "accuracy")}
    found["products"] = {**stores, "accuracy": address, **files}
    return check_receipt(json.loads(to_json(found)))


def check_receipt(receipt: Mapping[str, Any]) -> Receipt:
    """The receipt itself if it has every field of the design; ShapeError naming the first that it lacks."""
    _need(receipt, (*_HEADER_FIELDS, "stages", "savings", "products"), "receipt")
    for number, stage in enumerate(receipt["stages"]):
        _need(stage, _STAGE_FIELDS, f"receipt.stages[{number}]")
        if stage["state"] not in get_args(State):
            place = f"receipt.stages[{number}].state"
            raise ShapeError(f"{place} must be one of {', '.join(get_args(State))}; got {stage['state']!r}")
    savings = receipt["savings"]
    costs = OF_A_RASTER if receipt["source"] == RASTER else COSTS
    _need(savings, costs, "receipt.savings")
    for name in costs:
        place = f"receipt.savings.{name}"
        _need(savings[name], _SAVING_FIELDS + (_SPLIT_FIELDS if name == "multiply_adds" else ()), place)
        if savings[name]["full_is"] not in ("measured", "predicted"):
            raise ShapeError(f"{place}.full_is must be measured or predicted, got {savings[name]['full_is']!r}")
    if "segment_wall_s" in savings:
        _need(savings["segment_wall_s"], ("done", "full"), "receipt.savings.segment_wall_s")
    if receipt.get("accuracy_is", "judged") not in get_args(AccuracyIs):
        known = ", ".join(get_args(AccuracyIs))
        raise ShapeError(f"receipt.accuracy_is must be one of {known}; got {receipt['accuracy_is']!r}")
    if receipt.get("accuracy_is") == "judged":
        _need(receipt, ("judged", "accuracy"), "receipt")
    if "accuracy" in receipt:
        accuracy, place = receipt["accuracy"], "receipt.accuracy"
        _need(accuracy, ("miou", "per_class_iou", "none", "all", "gap_closed", "controls"), place)
        for name in ("none", "all"):
            _need(accuracy[name], ("miou", "per_class_iou"), f"{place}.{name}")
        for policy, control in accuracy["controls"].items():
            _need(control, ("miou", "spread"), f"{place}.controls.{policy}")
    for number, effect in enumerate(receipt.get("effects", ())):
        _need(effect, _EFFECT_FIELDS, f"receipt.effects[{number}]")
    if "effects_total" in receipt:
        _need(receipt["effects_total"], _TOTAL_FIELDS, "receipt.effects_total")
    return cast("Receipt", receipt)


def is_pending(receipt: Mapping[str, Any]) -> bool:
    """Whether a run was published before its map was judged, and has not been judged since."""
    return receipt.get("accuracy_is") == "pending"


def areas_on_ground(receipt: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Hectares of each class, where the survey was put on the ground."""
    ground = receipt.get("ground")
    areas = ground.get("areas_ha") if isinstance(ground, Mapping) else None
    return areas if isinstance(areas, Mapping) else None


def _need(part: object, names: Iterable[str], place: str) -> None:
    if not isinstance(part, Mapping):
        raise ShapeError(f"{place} must be a table with named fields, got {type(part).__name__}")
    for name in names:
        if name not in part:
            raise ShapeError(f"{place}.{name} is missing; a receipt has every field of the design (null if not known)")


def comparable(receipt: Receipt) -> dict[str, Any]:
    """What two runs of the same seed and settings must agree on.

    Without times, memory, the archive's place, whether a stage was read or made, hashes of manifests (which hold their
    times), the size of the evaluation (which holds times, in more digits or fewer), and the addresses of the products
    (their names stay).
    """
    times = ("started", "finished", "judged")
    same: dict[str, Any] = {key: value for key, value in receipt.items() if key not in times}
    same["settings"] = {key: value for key, value in receipt["settings"].items() if key != "out"}
    same["stages"] = [
        _without(stage, (*_OF_ONE_RUN, *(("bytes_out",) if stage["name"] == JUDGING else ())))
        for stage in receipt["stages"]
    ]
    same["savings"] = _without(receipt["savings"], ("segment_wall_s",))
    same["products"] = sorted(receipt["products"])
    return same


def _without(part: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {key: value for key, value in part.items() if key not in set(names)}
