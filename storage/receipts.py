"""Define the receipt of a run, and say which value of one is not valid: receipts also come from other people.

Costs against the reference, accuracy, findings, settings and products. Numbers are finite, and texts of limited length.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from spectralzoom.pipeline.errors import shortened, visible
from spectralzoom.pipeline.words import MOST_NAME, moment_of

Facts = dict[str, Any]
MOST_TEXT, MOST_SIZE, MOST_SHOWN = 20_000, 1e30, 60  # characters, of a number, characters of a value in a message


def _moment(text: str) -> str:
    if moment_of(text) is None:
        raise ValueError("expected a day or moment in ISO 8601")
    return text


Name = Annotated[str, Field(max_length=MOST_NAME)]
Address = Annotated[str, Field(max_length=4096)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Moment = Annotated[str, AfterValidator(_moment)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)


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

    captured: Count  # as the camera delivers them, of all passes
    written: Count  # stores that were built, including cleared ones, and spools
    kept: Count  # its stores with their inputs, but for raw lines that ``keep`` drops
    reference: Count


class Score(_Part):
    """Score of one map, 0..1, over the classes of the labels; IoU is null for a class without labels.

    ``false_classes`` are the pixels of mapped classes without labels.
    """

    miou: float | None
    per_class_iou: dict[Name, float | None]
    overall_accuracy: float | None = None
    false_classes: dict[Name, Count] | None = None
    confusion: list[list[Count]] | None = None

    @model_validator(mode="after")
    def _is_square(self) -> Score:
        size = len(self.per_class_iou)
        if self.confusion is not None and [len(row) for row in self.confusion] != [size] * size:
            raise ValueError(f"confusion is not of {size} x {size} classes")
        return self


class Control(Score):
    """The best uniform scan of the same seconds, captured and read as the survey was, with its costs."""

    scan: str
    capture_s: float
    kept: Count  # bytes
    multiply_adds: float


class StageRow(_Part):
    """One stage; figures of a store that was found are null."""

    name: Name
    key: Name | None  # None of a stage that is left out
    state: Literal["ran", "cached", "left out"]
    why: str = ""  # it is left out
    wall_s: float | None = None
    cpu_s: float | None = None
    peak_rss_bytes: Count | None = None
    bytes_in: Count | None = None
    bytes_out: Count | None = None


class SurveySettings(_Part):
    """The settings that archives are searched and shown by; a survey checks all of them when it takes them over."""

    scene: Address | None = None
    source: Name | None = None
    name: Name | None = None
    visit: Name | None = None
    keep: Name | None = None
    seed: Count | None = None
    budget: float | None = None
    day: int | None = None
    hour: float | None = None


class FieldFacts(_Part):
    """Size of the field: of a pixel on the ground [m]."""

    ground_pixel_m: float | None = None


class Areas(_Part):
    """Pixels and hectares of each class."""

    px: dict[Name, Count] | None = None
    ha: dict[Name, float] | None = None


class ReceiptFields(_Part):
    """All fields of a receipt; those from ``field`` to ``pixels`` are findings, each present only if it applies."""

    warnings: list[str] | None = None  # about the map, whose score then is not predicted
    survey: Name
    source: Name
    scene: Address
    seed: Count
    started: Moment  # ISO 8601, as all times
    finished: Moment
    acquired: Moment | None = None  # when the light was captured, by visit or file, perhaps long before ``started``
    versions: dict[Name, Name]
    settings: SurveySettings
    stages: list[StageRow]
    savings: Savings
    data_bytes: DataBytes
    accuracy: Score | None = None  # against labels
    control: Control | None = None  # the best uniform scan of the same seconds
    training_scene: Literal["all", "other pixels"] | None = None  # what of the scene the weights learned from
    effects: list[Facts] | None = None  # of a simulated source, with their bounds
    effects_total: Facts | None = None  # sum of the bounds beside the tolerance, and seconds saved
    field: FieldFacts | None = None  # its size, field of view, ground pixel and range, hectares an hour
    plan: Facts | None = None  # how the fine pass was laid out
    scans: Facts | None = None  # uniform ones by the scan performance table, where there is one
    recording: Facts | None = None  # of recorded sweeps: lines read and recorded, seconds of a camera
    extent: Facts | None = None  # which part of a field with a prior map was captured, and what was expected of it
    signal: Facts | None = None  # of captured spectra: which fraction has saturated bands
    kept: Facts | None = None  # of a uniform scan that is kept and read in part: patches, costs of all
    prior_map: Facts | None = None  # what became of the prior map
    pointing: Facts | None = None  # where the mirror may look beside the plan
    lines: Facts | None = None  # sweeps with lines lost, repeated, out of order or invalid
    areas: Areas  # px of each class; ha if a pixel's size is known; place of most
    ground: Facts | None = None  # with a pose or a placed scene: grid, what changed, what is old
    zones: Facts | None = None  # where zones leave something out: what is kept
    plots: list[Facts] | None = None  # where plots are given: ground, classes, confidence of each
    unlike: Facts | None = None  # distances of mean and spectra from the training, where it is unlike that
    expected: Facts | None = None  # mIoU and error of the map by its own probabilities, or why it is not predicted
    pixels: dict[Name, Count] | None = None  # where some have no value, no reading or no class: how many
    products: dict[Name, Address]


def receipt_problem(receipt: object, *, whole: bool = False) -> str | None:
    """Return the first value of a receipt that is not valid, with its key; None without one.

    A key that is missing is a problem of a ``whole`` receipt alone.
    """
    if wrong := next(_out_of_range(receipt, ""), None):
        return wrong
    try:
        ReceiptFields.model_validate(receipt)
    except ValidationError as error:
        for one in error.errors(include_url=False):
            place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in one["loc"]).lstrip(".")
            if one["type"] != "missing":
                why = one["msg"].removeprefix("Value error, ")
                return f"{_shown(place)}: {why}, got {_shown(repr(one['input']))}"
            if whole:
                return f"{_shown(place)} is missing"
    return None


def _out_of_range(value: object, place: str, most: int = MOST_TEXT) -> Iterator[str]:
    """Yield the numbers that are not finite or beyond all sizes, and texts and keys that are too long."""
    if isinstance(value, str) and len(value) > most:
        yield f"{_shown(place)} has {len(value)} characters, expected at most {most}"
    elif isinstance(value, int | float) and not abs(value) < MOST_SIZE:  # NaN too
        yield f"{_shown(place)} is no finite number below {MOST_SIZE:g}, got {_shown(repr(value))}"
    elif isinstance(value, Mapping):
        for key, one in value.items():
            yield from _out_of_range(key, f"a key of {place or 'the receipt'}", MOST_NAME)
            yield from _out_of_range(one, f"{place}.{key}".lstrip("."))
    elif isinstance(value, list):
        for number, one in enumerate(value):
            yield from _out_of_range(one, f"{place}[{number}]")


def _shown(text: str) -> str:
    return shortened(visible(text), MOST_SHOWN)
