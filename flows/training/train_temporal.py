"""`spectralzoom train --train-temporal`: train the temporal reader on lands over several days.

Built-in lands are scanned on several days. The noise model turns each scan into scans of shorter exposure and wider
line spacing, which the weights segment. Other lands then measure what the prior map gains.
"""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from spectralzoom.flows.terminal.progress import one_after_the_other, show_text
from spectralzoom.flows.training.data import Report, check_out
from spectralzoom.flows.training.train import check_counts
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.models.evaluation.metrics import confusion, mean_iou
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.reading.inference import map_of_columns
from spectralzoom.models.reading.prior_map import CurrentVisit, PriorMap, first_probabilities, fuse, pooled
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation
from spectralzoom.models.training.examples import Example, observe_scene
from spectralzoom.models.training.temporal import PastPass, TemporalTraining, Visit, train_reader
from spectralzoom.models.weights.files import Weights, add_reader, describe_weights, load_reader, load_weights
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.laws import FARM_NAMES

SHAPE = (512, 640)  # (y, x) of a land
FLAGS = ("train_temporal", "scenes", "steps", "minutes", "seed")  # that apply
LANDS = 40
FIRST_SEED, JUDGED_SEED = 200_000, 300_000  # of lands of the training, and of those that judge it
VISITS = 5  # of each land
DAYS = (95, 290)  # of the year, of first visits
LAST_DAY = 318  # of any visit
SPRING = (95, 135)  # days when most changes
IN_SPRING = 0.4  # fraction of lands that are first visited then in any case
GAPS = (0, 1, 1, 2, 3, 3, 5, 6, 6, 7, 7, 10, 14)  # days between two
HOURS = (9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0)
SPACINGS = {1: 0.3, 2: 0.5, 4: 0.2}  # line spacing [px] -> fraction of the passes
MIN_EXPOSURE_MS, MAX_EXPOSURE_MS = 3.0, 50.0
PASSES = 2  # of each visit
JUDGED_DAY = 172
JUDGED_AFTER = (1, 3, 7)  # days
JUDGED_LANDS = 3
MAPS = {
    "kept": "first map",
    "extent": "visit alone",
    "anew": "new full scan",
    "surer": "more confident",
    "prior_map": "fused",
}
BEFORE, NOW = (1, 25.0), (2, 5.0)  # line spacing [px] and exposure [ms] of the judged scans


def train_temporal(request: TrainRequest, report: Report = lambda what, done, figure: None) -> dict[str, Any]:
    """Train a temporal reader for weights, judge it on other lands, save it, and return the record of its file.

    The training starts from the reader of the weights if they have one.
    Raises SettingsError: a flag is for other trainings, the dataset is not the built-in farm, its classes are not those
    of the weights, or the file cannot be written; WeightsError: the weights cannot be read.
    """
    flags, path = request.flags, request.flags.train_temporal
    assert path is not None
    check_counts(flags)
    for one in fields(flags):
        if one.name not in FLAGS and getattr(flags, one.name) != one.default:
            raise SettingsError(f"--{one.name.replace('_', '-')} is not for --train-temporal; leave it out")
    settings = TemporalTraining(flags.minutes, flags.steps, flags.seed)
    count = LANDS if flags.scenes is None else flags.scenes
    if request.dataset not in FARM_NAMES:
        raise SettingsError(
            f"--train-temporal {request.dataset}: expected farm, the only data set with several days of one land. "
            "Weights without a temporal reader use the more confident of prior map and visit"
        )
    check_out(request.out)
    weights = load_weights(path)
    if weights.class_names != CLASSES:
        raise SettingsError(f"--train-temporal {path}: expected weights of the farm's classes, {', '.join(CLASSES)}")
    lands = []
    for number in range(count):
        seed = FIRST_SEED + number
        report("visiting lands", number / count, f"land {seed}")
        rng = np.random.default_rng([settings.seed, seed])
        lands.append([_visit(weights, seed, *moment, rng) for moment in _moments(rng)])
    known = describe_weights(path).reader
    reader, steps = train_reader(
        lands,
        settings,
        lambda now: report("training", now.done, f"step {now.step}, loss {now.loss:.3f}"),
        start=None if known is None else load_reader(path),
    )
    record = {
        "command": request.command,
        "lands": [FIRST_SEED + number for number in range(count)],
        "settings": asdict(settings),
        "steps": steps,
        "started_from": None if known is None else known.key,
        "validation": judge_temporal(weights, reader, settings.seed, report),
    }
    add_reader(path, request.out, reader, record)
    return record


def _moments(rng: np.random.Generator) -> list[tuple[int, float]]:
    """Draw days of the year with hours, in ascending order."""
    days = [int(rng.integers(*(SPRING if rng.random() < IN_SPRING else DAYS)))]
    while len(days) < VISITS:
        days.append(min(days[-1] + int(rng.choice(GAPS)), LAST_DAY))
    return sorted((day, float(rng.choice(HOURS))) for day in days)


def _visit(weights: Weights, seed: int, day: int, hour: float, rng: np.random.Generator) -> Visit:
    """Return a land on a day, as scans drawn at random show it."""
    land = _observed(weights, seed, day, hour, rng)
    drawn = []
    for _ in range(PASSES):
        step = int(rng.choice(list(SPACINGS), p=list(SPACINGS.values())))
        exposure_ms = float(np.exp(rng.uniform(np.log(MIN_EXPOSURE_MS), np.log(MAX_EXPOSURE_MS))))
        observation = _scan(weights, land, step, exposure_ms, rng)
        probability = np.exp(observation.log_probability).astype(np.float16)
        drawn.append(PastPass(step, observation.light, probability, observation.coarse.astype(np.float16)))
    labels = np.where(np.isin(land.labels, weights.config.untaught), np.uint8(UNLABELLED), land.labels)
    return Visit(day + hour / 24, labels, drawn)


def _observed(weights: Weights, seed: int, day: int, hour: float, rng: np.random.Generator) -> Example:
    """Image the farm of a seed on a day by every line at the reference exposure, in normalised columns."""
    camera = LineCamera()
    scene = farm_scene(seed, SHAPE, camera=camera, day=day, hour=hour)
    seen = observe_scene(scene, camera, SceneGrid(*SHAPE, weights.config.patch), weights.basis, rng)
    return replace(seen, columns=weights.normalisation.apply(seen.columns, np.ones(weights.basis.columns, np.bool_)))


def _scan(weights: Weights, land: Example, step: int, exposure_ms: float, rng: np.random.Generator) -> CurrentVisit:
    """Return a visit by a uniform scan, segmented by the weights."""
    assert land.noise is not None
    light = exposure_ms / REFERENCE_MS
    augmentation = CaptureAugmentation(weights.normalisation)
    scan = augmentation.scanned(land.columns, land.noise, light=light, step=step, rng=rng)
    _, every_class = map_of_columns(weights, scan, SceneGrid(*SHAPE, weights.config.patch), LineSpec(light, step))
    return CurrentVisit(every_class, np.ones(SHAPE, np.bool_), pooled(scan), light, step)


def judge_temporal(weights: Weights, reader: TemporalReader, seed: int, report: Report) -> list[dict[str, float]]:
    """Return the mean mIoU of maps some days after a first visit, on lands that training did not see.

    ``kept`` is the first map and ``extent`` the later visit alone. ``prior_map`` is their fusion by the reader,
    ``surer`` without it. ``anew`` is a second scan like the first.
    """
    scores = np.empty((len(JUDGED_AFTER), JUDGED_LANDS, len(MAPS)))
    for number in range(JUDGED_LANDS):
        own = JUDGED_SEED + number
        rng = np.random.default_rng([seed, own])
        before = _scan(weights, _observed(weights, own, JUDGED_DAY, 11.0, rng), *BEFORE, rng)
        for row, days in enumerate(JUDGED_AFTER):
            report("judging", (number + row / len(JUDGED_AFTER)) / JUDGED_LANDS, f"{days} d")
            later = _observed(weights, own, JUDGED_DAY + days, 11.0, rng)
            now, anew = (_scan(weights, later, *how, rng) for how in (NOW, BEFORE))
            prior_map = PriorMap(first_probabilities(before), before.coarse, float(days), JUDGED_DAY + days)
            fused = fuse(prior_map, now, None), fuse(prior_map, now, reader)
            maps = [*map(first_probabilities, (before, now, anew)), *fused]
            scores[row, number] = [mean_iou(confusion(later.labels, one.classes()[0], len(CLASSES))) for one in maps]
    means = scores.mean(axis=1).tolist()
    return [
        {"days": float(days), **dict(zip(MAPS, row, strict=True))}
        for days, row in zip(JUDGED_AFTER, means, strict=True)
    ]


def run_remember(request: TrainRequest, console: Console) -> dict[str, Any]:
    """Train with a progress bar on ``console``, and return the record of the file."""
    with one_after_the_other(console) as report:
        record = train_temporal(request, report)
    show_text(f"weights with a temporal reader: {request.out}, {record['steps']} steps", console)
    title = f"mIoU on {JUDGED_LANDS} lands that training did not see"
    table = Table("days later", *MAPS.values(), title=title)
    for row in record["validation"]:
        table.add_row(f"{row['days']:g}", *(f"{row[name]:.1%}" for name in MAPS))
    console.print(table)
    return record
