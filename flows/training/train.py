"""`spectralzoom train`: labelled scenes in, one file of weights out, with the split and the figures kept in it."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from flows.terminal.progress import one_after_the_other
from flows.training.data import (
    TrainingData,
    alike_notes,
    either_mask,
    only_class,
    open_training_data,
    pack_mask,
    trained_pixels,
)
from flows.training.familiarity import SeenScenes, measured_calibration, save_beside, trained_on
from flows.training.figures import judge_scans, validate
from flows.training.look import observe_scene
from models.network.segmenter import Segmenter
from models.network.sizes import PRESETS, Positions, Preset, SegmenterConfig
from models.network.spectral import SpectralBasis
from models.training.examples import Example, Observation, measured_normalisation, normalised
from models.training.looks import REFERENCE_MS, Looks
from models.training.start_weights import StartFile
from models.training.train import Progress, TrainingSettings, train
from models.weights.files import CALIBRATION, AnyWeights, Weights, save_weights, with_record
from models.weights.sealed_files import read_checkpoint
from models.weights.trained_on import TRAINED_ON
from pipeline.errors import SceneError, SettingsError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.simulator.scenes.farm.farm_scene import FARM_NAMES
from pipeline.simulator.scenes.scene import RasterScene

FRAME_CROP, FARM_CROP = 384, 256  # px
WHOLE_CROP = 1024  # px; the paper's network counts its places along the whole scene, a crop's would be others


@dataclass(frozen=True)
class TrainRequest:
    """What to train on and how; ``patch`` and ``columns`` follow from the data where None."""

    dataset: str
    out: Path
    hold_out: tuple[str, ...] = ()
    validation: int | None = None
    scenes: int | None = None  # of a built-in farm; by its law where None
    patch: int | None = None
    factor: int = 4
    columns: int = 24
    width: int = 24
    positions: Positions = "2d"
    preset: Preset = "two-scale"
    tokens: dict[str, Any] = field(default_factory=dict)  # dim, layers, heads, mlp_ratio, where not the usual ones
    init: Path | None = None  # weights to begin from
    choices: dict[str, Any] = field(default_factory=dict)  # of load_data_set: labels, bands, wavelengths, masks
    settings: TrainingSettings = field(default_factory=TrainingSettings)
    camera: LineCamera = field(default_factory=LineCamera)
    command: str = ""


Report = Callable[[str, float, str], None]  # what is done, how far 0..1, a figure


def train_weights(
    request: TrainRequest,
    report: Report = lambda what, done, figure: None,
    tell: Callable[[str], None] = lambda note: None,
) -> dict[str, Any]:
    """Train, validate and save; give the record that stands in the file. ``tell`` is told what was left out.

    Raises SceneError: no labels, one class only, or scenes whose bands or classes differ; SettingsError: a folder to
    write to that does not exist, a folder in the place of a file, or sizes that do not fit.
    """
    checkpoint = request.out.with_name(request.out.name + ".checkpoint")
    _check_places(request.out, checkpoint)
    read_checkpoint(checkpoint)  # refuses a damaged one before minutes are spent
    start = open_start(request.init, request.tokens, request.preset)
    data = open_training_data(
        request.dataset,
        request.validation,
        request.scenes,
        request.camera,
        hold_out=request.hold_out,
        **request.choices,
    )
    refuse_seen(start, data)
    for note in data.notes:
        tell(note)
    seen, about = observe_all(request, data, data.train, "looking at scenes", report)
    _question_labels(about, request.dataset, tell)
    normalisation = measured_normalisation(seen, math.sqrt(request.settings.darkest_ms * REFERENCE_MS))
    reached = np.ones(about.basis.columns, bool)
    examples = [normalised(observation, normalisation, reached) for observation in seen]
    config = _config(request, about)
    begun = None
    if start is not None:
        config = replace(config, patch_kernel=start.patch_kernel)
        begun = start.begin(config, about.basis, normalisation, about.names)
    state = None if begun is None else begun.state

    def progress(now: Progress) -> None:
        report("training", now.done, f"step {now.step}, loss {now.loss:.3f}")

    own = {"train": dict(about.keys), "validation": list(data.validation), "held_out": list(data.held_out)}
    split = joined_split(
        own | {"pixels": dict(about.pixels)}, start
    )  # before validation scenes are looked at: what was trained on
    looks = None
    if request.settings.darkest_ms < REFERENCE_MS:
        looks = Looks(normalisation, darkest_ms=request.settings.darkest_ms)
    model, summary = train(
        config,
        examples,
        normalisation.gain_shift,
        request.settings,
        progress,
        start=state,
        looks=looks,
        checkpoint=checkpoint,
    )
    weights = AnyWeights(model, about.basis, normalisation, about.names, about.colours)
    kept, _ = observe_all(request, data, data.validation, "looking at validation scenes", report, about)
    frames = [normalised(one, normalisation, reached) for one in kept]
    whole = SeenScenes(examples, frames, about.wavelength_nm, request.settings.darkest_ms, request.settings.seed)
    told = trained_on(data, whole, about.names)
    record = {
        "command": request.command,
        "data": data.law,
        TRAINED_ON: told.as_dict(),
        "split": split,
        "settings": asdict(request.settings),
        "camera": asdict(request.camera),
        "training": summary,
        **_figures(weights, frames, looks, request.settings.seed, report),
        **({} if begun is None else {"begun_from": begun.record}),
    }
    save_weights(with_record(weights, **record), request.out)
    checkpoint.unlink(missing_ok=True)
    if isinstance(model, Segmenter):
        why = save_beside(_two_scale(weights), request.out, whole, told, {"command": request.command}, report)
        record = record if why is None else {**record, "familiar": why}
    return record


def _two_scale(weights: AnyWeights, **entries: Any) -> Weights:
    """Weights of a segmenter as what they are, with entries in their record."""
    assert isinstance(weights.network, Segmenter)
    own = (weights.basis, weights.normalisation, weights.class_names, weights.class_colours)
    return Weights(weights.network, *own, entries)


def _figures(
    weights: AnyWeights, frames: list[Example], looks: Looks | None, seed: int, report: Report
) -> dict[str, Any]:
    """What the record says of scenes kept for validation; of plain scans too, where training saw such looks."""
    figures = {"validation": validate(weights, frames, seed, lambda row: report("validating", 0.0, row))}
    if not isinstance(weights.network, Segmenter):
        return figures
    calibration = measured_calibration(_two_scale(weights), frames, seed)
    figures |= {} if calibration is None else {CALIBRATION: calibration}
    if looks is None:
        return figures
    two_scale = _two_scale(weights, calibration=calibration or {})
    scans = judge_scans(two_scale, frames, looks, seed, lambda row, done: report("judging scans", done, row))
    return figures if scans is None else figures | {"scans": scans}


def _check_places(out: Path, checkpoint: Path) -> None:
    if not out.parent.is_dir():
        raise SettingsError(f"-o {out}: the folder {out.parent} does not exist; make it first")
    if out.is_dir():
        raise SettingsError(f"-o {out} is a folder, expected a file; name the weights in it")
    for path in (checkpoint, *(path.with_name(path.name + ".part") for path in (out, checkpoint))):
        if path.is_dir():
            raise SettingsError(
                f"-o {out}: {path} is a folder, and training keeps a file of that name; move it away, or name other "
                "weights"
            )


@dataclass
class About:
    """What all scenes of a data set have in common, and what training saw of each."""

    basis: SpectralBasis
    names: tuple[str, ...]
    colours: NDArray[np.uint8]
    patch: int
    wavelength_nm: NDArray[np.float64]
    keys: dict[str, str] = field(default_factory=dict)  # scene -> identity of its light
    pixels: dict[str, str] = field(default_factory=dict)  # identity -> trained pixels, where not all labelled ones
    alike: dict[str, str] = field(default_factory=dict)  # scene -> class, where all its labels are one


def observe_all(
    request: TrainRequest,
    data: TrainingData,
    names: tuple[str, ...],
    what: str,
    report: Report,
    about: About | None = None,
) -> tuple[list[Observation], About]:
    """Look at named scenes of the data, and say what they have in common with each other, and with earlier ones."""
    seen = []
    for number, (name, scene) in enumerate(zip(names, data.scenes(names), strict=True)):
        report(what, number / len(names), name)
        known = about or _common(request, scene)
        _check_alike(scene, known)
        known.keys[name] = scene.key
        mask = trained_pixels(scene)
        if request.choices.get("train_mask") is not None:
            known.pixels[scene.key] = pack_mask(mask)
        about = known
        if (alone := only_class(scene)) is not None:
            known.alike[name] = alone
        grid = SceneGrid(*scene.shape, known.patch, request.factor)
        rng = np.random.default_rng([request.settings.seed, 0x0B5, number])
        seen.append(observe_scene(scene, request.camera, grid, known.basis, rng))
    if about is None:
        raise SceneError(f"{request.dataset} has no scene to train on")
    return seen, about


def _question_labels(about: About, dataset: str, tell: Callable[[str], None]) -> None:
    """Tell which scenes have labels of one class (SceneError: all of them, and of the same)."""
    notes = alike_notes(about.alike)
    if len(about.alike) == len(about.keys) and len(notes) == 1:
        raise SceneError(f"{dataset}: training needs two or more classes, and {notes[0]}")
    for note in notes:
        tell(note)


def _common(request: TrainRequest, scene: RasterScene) -> About:
    trained_pixels(scene)  # refuses a scene without labels
    if len(scene.class_names) < 2:
        notes = alike_notes({scene.name: scene.class_names[0]})
        raise SceneError(f"{request.dataset}: training needs two or more classes, and {notes[0]}")
    basis = SpectralBasis.spanning(scene.wavelength_nm, request.columns)
    patch = request.patch or suggested_patch(scene.shape, built_in=request.dataset in FARM_NAMES)
    about = About(basis, scene.class_names, scene.class_colours, patch, scene.wavelength_nm)
    _config(request, about)  # refuses sizes that do not fit before the first look
    return about


def suggested_patch(shape: tuple[int, int], *, built_in: bool) -> int:
    """Patch size for scenes of this shape: 16 for the farm, 32 for frames, less where a scene would hold few seats."""
    if built_in:
        return 16
    return 32 if min(shape) >= 512 else 16 if min(shape) >= 256 else 8


def usual_crop(dataset: str, preset: Preset) -> int:
    """Size of the crops to train on [px]: whole scenes for the paper's network, as far as they are square."""
    return WHOLE_CROP if preset == "paper" else FARM_CROP if dataset in FARM_NAMES else FRAME_CROP


def _check_alike(scene: RasterScene, about: About) -> None:
    if scene.class_names != about.names:
        raise SceneError(f"scene {scene.name} has classes {scene.class_names}, the scenes before it {about.names}")
    if not np.array_equal(scene.wavelength_nm, about.wavelength_nm):
        raise SceneError(f"scene {scene.name} has other bands than the scenes before it; train on scenes of one camera")


def _config(request: TrainRequest, about: About) -> SegmenterConfig:
    try:
        return SegmenterConfig(
            classes=len(about.names),
            columns=about.basis.columns,
            patch=about.patch,
            factor=request.factor,
            width=request.width,
            **request.tokens,
            **{"positions": request.positions, **PRESETS[request.preset]},
        )
    except ValueError as error:
        raise SettingsError(f"{error}; choose another --patch or --factor, --dim or --heads") from error


Split = dict[str, Any]


def open_start(init: Path | None, tokens: Mapping[str, Any], preset: Preset) -> StartFile | None:
    """The file to begin from, if any. SettingsError: not there, or another network; WeightsError: no known kind."""
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
        console.print(f"  note: {begun['unsealed']}", markup=False, soft_wrap=True)
    if begun["licence"]:
        console.print(f"  its licence: {begun['licence']}")


def run_train(request: TrainRequest, console: Console) -> dict[str, Any]:
    """Train with a progress bar on ``console``; give the record kept in the weights."""
    _check_counts(request)
    request = replace(request, command=request.command or asked_command())
    with one_after_the_other(console) as report:
        record = train_weights(
            request, report, lambda note: console.print(f"note: {note}", markup=False, soft_wrap=True)
        )
    if "begun_from" in record:
        print_start(record["begun_from"], console)
    _print_figures(record, request, console)
    return record


def _check_counts(request: TrainRequest) -> None:
    settings = request.settings
    counts = {
        "--steps": settings.steps,
        "--minutes": settings.minutes,
        "--batch": settings.batch,
        "--crop": settings.crop,
        "--scenes": request.scenes,
        "--patch": request.patch,
        "--factor": request.factor,
        "--columns": request.columns,
        **{"--" + name.replace("_", "-"): size for name, size in request.tokens.items()},
    }
    for name, value in counts.items():
        if value is not None and not value > 0:
            raise SettingsError(f"{name} must be above 0, got {value}")
    for name, number in {"--validation": request.validation, "--seed": settings.seed}.items():
        if number is not None and number < 0:
            raise SettingsError(f"{name} must be 0 or more, got {number}")
    if not 0 < settings.darkest_ms <= REFERENCE_MS:
        raise SettingsError(
            f"--darkest-ms must be above 0 and at most {REFERENCE_MS:g}, the exposure that scenes are looked at with,"
            f" got {settings.darkest_ms}"
        )
    if request.positions == "paper" and request.preset not in ("two-scale", "paper"):
        raise SettingsError(
            f"--positions paper is not for --preset {request.preset}, which reads one scale; leave it out"
        )


def asked_command() -> str:
    """The command without folders: a machine's paths do not belong in weights."""
    words = [Path(word).name if "/" in word else word for word in sys.argv[1:]]
    return shlex.join(["spectralzoom", *words])


def _print_figures(record: dict[str, Any], request: TrainRequest, console: Console) -> None:
    out = request.out
    console.print(f"weights: {out} ({out.stat().st_size / 1e6:.1f} MB), {record['training']['steps']} steps")
    if "familiar" in record:
        console.print(record["familiar"], markup=False, soft_wrap=True)
    figures = record["validation"]
    if figures is None:
        given = "--weights" if request.preset == "two-scale" else "--weights OTHERS --control"
        console.print(
            "no scene was kept for validation; to judge the weights on scenes that they were not trained on: "
            f"spectralzoom evaluate {request.dataset} {given} {out}",
            soft_wrap=True,
        )
        return
    title = f"{figures['scenes']} scene{'s' if figures['scenes'] > 1 else ''} kept for validation"
    caption = f"none: the coarse pass alone; all: fine everywhere; else fine at {figures['share_of_seats']:.0%}"
    table = Table("placement", "mIoU", "overall", title=title, caption=caption)
    for name in ("none", "random", "sobel", "entropy", "gain", "all"):
        if name in figures:  # a control has some of them
            table.add_row(name, *(f"{figures[name][figure]:.1%}" for figure in ("miou", "overall_accuracy")))
    console.print(table)
