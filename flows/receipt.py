"""The receipt of a run: what was captured, stored and computed against everything, and what that did to accuracy.

One plain dictionary feeds ``receipt.json``, the terminal's last block (`print_table`) and the report.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, NotRequired, TypedDict, cast

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.figures import format_bytes, format_count, format_percent, format_points, format_seconds
from pipeline.errors import ShapeError

State = Literal["ran", "cached", "skipped", "failed"]


class Saving(TypedDict):
    """One cost: what was spent, what the full scan costs, their ratio (null where full is 0)."""

    done: float
    full: float
    ratio: float | None
    full_is: Literal["measured", "predicted"]


class Split(Saving):
    """Multiply-adds, also told apart by what they were for."""

    glance: float
    score: float
    encode: float
    decode: float


class Savings(TypedDict):
    """What the run spent against the cheapest full scan."""

    lines: Saving
    samples: Saving
    bytes_raw: Saving
    bytes_stored: Saving
    capture_s: Saving
    tokens: Saving
    multiply_adds: Split
    segment_wall_s: NotRequired[dict[str, float]]


class Score(TypedDict):
    """mIoU and IoU by class of one map, 0..1; null for a class that neither map nor truth holds."""

    miou: float | None
    per_class_iou: dict[str, float | None]


class Control(TypedDict):
    """mIoU of another placement of seats, and its spread over repeats (null where chance has no part)."""

    miou: float | None
    spread: float | None


class Accuracy(Score):
    """Accuracy against labels: this map, no fine seat, every fine seat, and other placements."""

    none: Score
    all: Score
    gap_closed: float | None
    controls: dict[str, Control]
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
    accuracy: NotRequired[Accuracy]
    effects: NotRequired[list[dict[str, Any]]]
    plan: NotRequired[dict[str, Any]]  # how the fine pass was laid out, and what the other orientation would cost
    pointing: NotRequired[dict[str, Any]]  # only where the mirror may look beside the plan
    lines: NotRequired[dict[str, Any]]  # sweeps with lines lost, repeated, out of order, late or invalid
    ground: NotRequired[dict[str, Any]]  # only with a pose: grid and hectares
    products: dict[str, str]


@dataclass(frozen=True)
class StageRecord:
    """One stage of a run. What was not measured (a stage read from the archive) is None."""

    name: str
    key: str
    state: State
    wall_s: float | None = None
    cpu_s: float | None = None
    peak_rss_bytes: int | None = None
    bytes_in: int | None = None
    bytes_out: int | None = None
    manifest_sha256: str | None = None  # of the store that the stage left; receipts of before have none


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
FINDINGS = ("plan", "pointing", "lines", "ground")
_SAVING_FIELDS = ("done", "full", "ratio", "full_is")
_SPLIT_FIELDS = ("glance", "score", "encode", "decode")
_STAGE_FIELDS = ("name", "key", "state", "wall_s", "cpu_s", "peak_rss_bytes", "bytes_in", "bytes_out")
_EFFECT_FIELDS = ("name", "state", "variant", "bound", "measured", "cost_s", "why")
_HEADER_FIELDS = ("survey", "source", "scene", "seed", "started", "finished", "versions", "settings")
_OF_ONE_RUN = (
    "wall_s",
    "cpu_s",
    "peak_rss_bytes",
    "state",
    "manifest_sha256",
)  # what another run of the same seed has otherwise
_STATES = ("ran", "cached", "skipped", "failed")


def build_receipt(
    header: Header,
    stages: Iterable[StageRecord],
    savings: Mapping[str, object],
    products: Mapping[str, str],
    *,
    accuracy: Mapping[str, object] | None = None,
    effects: Iterable[Mapping[str, object]] | None = None,
    findings: Mapping[str, object] | None = None,
) -> Receipt:
    """Put a receipt together in its fixed order and check that nothing is missing.

    Parameters
    ----------
    savings
        `COSTS` and, where measured, ``segment_wall_s``; each a mapping with the fields of `Saving`.
    accuracy
        Fields of `Accuracy`; None without labels.
    effects
        Rows with name, state, variant, bound, measured, cost_s, why; None for a source that is not simulated.
    findings
        Parts that not every survey has: `FINDINGS`.

    Raises
    ------
    ShapeError : a field is missing or not of the design; names it.
    """
    receipt: dict[str, object] = {**asdict(header), "stages": [asdict(stage) for stage in stages]}
    receipt["savings"] = {name: savings[name] for name in (*COSTS, "segment_wall_s") if name in savings}
    if accuracy is not None:
        receipt["accuracy"] = accuracy
    if effects is not None:
        receipt["effects"] = list(effects)
    receipt |= {name: found for name in FINDINGS if (found := (findings or {}).get(name))}
    receipt["products"] = dict(products)
    return check_receipt(json.loads(to_json(receipt)))


def check_receipt(receipt: Mapping[str, Any]) -> Receipt:
    """The receipt itself if it has every field of the design; ShapeError naming the first that it lacks."""
    _need(receipt, (*_HEADER_FIELDS, "stages", "savings", "products"), "receipt")
    for number, stage in enumerate(receipt["stages"]):
        _need(stage, _STAGE_FIELDS, f"receipt.stages[{number}]")
        if stage["state"] not in _STATES:
            place = f"receipt.stages[{number}].state"
            raise ShapeError(f"{place} must be one of {', '.join(_STATES)}; got {stage['state']!r}")
    _check_savings(receipt["savings"])
    if "accuracy" in receipt:
        _check_accuracy(receipt["accuracy"])
    for number, effect in enumerate(receipt.get("effects", ())):
        _need(effect, _EFFECT_FIELDS, f"receipt.effects[{number}]")
    return cast("Receipt", receipt)


def _check_savings(savings: Mapping[str, Any]) -> None:
    _need(savings, COSTS, "receipt.savings")
    for name in COSTS:
        place = f"receipt.savings.{name}"
        _need(savings[name], _SAVING_FIELDS + (_SPLIT_FIELDS if name == "multiply_adds" else ()), place)
        if savings[name]["full_is"] not in ("measured", "predicted"):
            raise ShapeError(f"{place}.full_is must be measured or predicted, got {savings[name]['full_is']!r}")
    if "segment_wall_s" in savings:
        _need(savings["segment_wall_s"], ("done", "full"), "receipt.savings.segment_wall_s")


def _check_accuracy(accuracy: Mapping[str, Any]) -> None:
    place = "receipt.accuracy"
    _need(accuracy, ("miou", "per_class_iou", "none", "all", "gap_closed", "controls"), place)
    for name in ("none", "all"):
        _need(accuracy[name], ("miou", "per_class_iou"), f"{place}.{name}")
    for policy, control in accuracy["controls"].items():
        _need(control, ("miou", "spread"), f"{place}.controls.{policy}")


def _need(part: object, names: Iterable[str], place: str) -> None:
    """Raise unless ``part`` is a mapping with all ``names``."""
    if not isinstance(part, Mapping):
        raise ShapeError(f"{place} must be a table with named fields, got {type(part).__name__}")
    for name in names:
        if name not in part:
            raise ShapeError(f"{place}.{name} is missing; a receipt has every field of the design (null if not known)")


def to_json(receipt: Mapping[str, object]) -> str:
    """JSON text, two spaces a level, in the receipt's own order; numbers that are not finite become null."""
    return json.dumps(_plain(receipt), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: object) -> object:
    """Plain lists, dictionaries and numbers; numpy's scalars by their ``item``."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def comparable(receipt: Receipt) -> dict[str, Any]:
    """What two runs of the same seed and settings must agree on.

    Without times, memory, the archive's place, whether a stage was read or made, hashes of manifests (which hold their
    times), the size of the evaluation (which holds times, in more digits or fewer), and the addresses of the products
    (their names stay).
    """
    same: dict[str, Any] = {key: value for key, value in receipt.items() if key not in ("started", "finished")}
    same["settings"] = {key: value for key, value in receipt["settings"].items() if key != "out"}
    same["stages"] = [
        _without(stage, (*_OF_ONE_RUN, *(("bytes_out",) if stage["name"] == "evaluate" else ())))
        for stage in receipt["stages"]
    ]
    same["savings"] = _without(receipt["savings"], ("segment_wall_s",))
    if "effects" in receipt:
        same["effects"] = [_without(effect, ("cost_s",)) for effect in receipt["effects"]]
    same["products"] = sorted(receipt["products"])
    return same


def _without(part: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {key: value for key, value in part.items() if key not in set(names)}


def headline(receipt: Receipt, looked_twice: float | None = None) -> str:
    """The run in one to three sentences that a farmer reads, plain text.

    ``looked_twice`` is the share of the field that was captured in detail, 0..1; None leaves it out.
    """
    capture = receipt["savings"]["capture_s"]
    twice = "" if looked_twice is None else f"The camera looked twice at {format_percent(looked_twice)} of the field. "
    text = (
        f"{twice}Capture took {format_seconds(capture['done'])} instead of {format_seconds(capture['full'])} "
        f"for a scan of everything ({format_percent(capture['ratio'])})."
    )
    accuracy = receipt.get("accuracy")
    if accuracy is None:
        return text
    every = accuracy["all"]["miou"]
    detail = "" if every is None else f", detail everywhere {format_points(every)}"
    return (
        f"{text} The map scores {format_points(accuracy['miou'])} of 100 against the truth; the coarse look alone "
        f"gives {format_points(accuracy['none']['miou'])}{detail}."
    )


COST_LABELS = {
    "capture_s": ("time at the camera", format_seconds),
    "lines": ("lines", format_count),
    "samples": ("samples on the field", format_count),
    "bytes_raw": ("raw data", format_bytes),
    "bytes_stored": ("stored data", format_bytes),
    "tokens": ("tokens of the model", format_count),
    "multiply_adds": ("multiply-adds of the model", format_count),
}


def print_table(receipt: Receipt, console: Console) -> None:
    """Print the receipt's three tables to the terminal: savings, accuracy (with labels), stages."""
    console.print(_savings_table(receipt["savings"]))
    if "accuracy" in receipt:
        console.print(_accuracy_table(receipt["accuracy"]))
    console.print(_stages_table(receipt["stages"]))


def _table(title: str, *columns: str) -> Table:
    """A table whose first column is text and whose others are figures."""
    table = Table(title=title, title_justify="left", title_style="bold", header_style="dim", box=SIMPLE_HEAD)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", no_wrap=number > 0)
    return table


def _savings_table(savings: Savings) -> Table:
    table = _table("Savings", "cost", "this survey", "everything", "ratio", "everything is")
    for name, (label, show) in COST_LABELS.items():
        entry = cast("Saving", savings[name])  # type: ignore[literal-required]
        table.add_row(label, show(entry["done"]), show(entry["full"]), format_percent(entry["ratio"]), entry["full_is"])
    if "segment_wall_s" in savings:
        done, full = savings["segment_wall_s"]["done"], savings["segment_wall_s"]["full"]
        ratio = format_percent(done / full) if full else "-"
        table.add_row("time of the model", format_seconds(done), format_seconds(full), ratio, "measured")
    return table


def _accuracy_table(accuracy: Accuracy) -> Table:
    table = _table("Accuracy against the truth", "seats", "mIoU", "spread")
    table.add_row("none: the coarse look alone", format_points(accuracy["none"]["miou"]), "")
    table.add_row("[bold]this survey[/bold]", f"[bold]{format_points(accuracy['miou'])}[/bold]", "")
    for policy, control in accuracy["controls"].items():
        spread = "" if control["spread"] is None else f"± {format_points(control['spread'])}"
        table.add_row(f"{control_seats(accuracy)} placed by {escape(policy)}", format_points(control["miou"]), spread)
    table.add_row("all: detail everywhere", format_points(accuracy["all"]["miou"]), "")
    table.add_row("gap from none to all closed", format_percent(accuracy["gap_closed"]), "")
    return table


def control_seats(accuracy: Mapping[str, Any]) -> str:
    """How the controls' seats are called: their share of all, each free of the others."""
    share = accuracy.get("controls_mode", {}).get("share_of_seats")
    return "other seats," if share is None else f"{format_percent(share)} of the seats, free,"


def _stages_table(stages: Iterable[Mapping[str, Any]]) -> Table:
    table = _table("Stages", "stage", "state", "wall", "peak memory", "written")
    colours = {"ran": "green", "cached": "cyan", "skipped": "dim", "failed": "bold red"}
    for stage in stages:
        state = f"[{colours[stage['state']]}]{stage['state']}[/]"
        peak, wrote = format_bytes(stage["peak_rss_bytes"]), format_bytes(stage["bytes_out"])
        table.add_row(escape(stage["name"]), state, format_seconds(stage["wall_s"]), peak, wrote)
    return table
