"""`spectralzoom train` as a command: counts are checked, a bar shows how far it is, figures are printed at the end."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from flows.terminal.progress import one_after_the_other
from flows.training.train import train_weights
from flows.training.train_scenes import TrainRequest
from models.network.sizes import Preset
from models.training.looks import REFERENCE_MS
from pipeline.errors import SettingsError
from pipeline.simulator.scenes.farm.farm_scene import FARM_NAMES

FRAME_CROP, FARM_CROP = 384, 256  # px
WHOLE_CROP = 1024  # px; the paper's network counts its places along the whole scene, a crop's would be others


def usual_crop(dataset: str, preset: Preset) -> int:
    """Size of the crops to train on [px]: whole scenes for the paper's network, as far as they are square."""
    return WHOLE_CROP if preset == "paper" else FARM_CROP if dataset in FARM_NAMES else FRAME_CROP


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
        if request.settings.darkest_ms < REFERENCE_MS and request.preset == "two-scale":
            console.print("nor has the file a record of plain scans, by which survey --seconds chooses", soft_wrap=True)
        return
    title = f"{figures['scenes']} scene{'s' if figures['scenes'] > 1 else ''} kept for validation"
    caption = f"none: the coarse pass alone; all: fine everywhere; else fine at {figures['share_of_seats']:.0%}"
    table = Table("placement", "mIoU", "overall", title=title, caption=caption)
    for name in ("none", "random", "sobel", "entropy", "gain", "all"):
        if name in figures:  # a control has some of them
            table.add_row(name, *(f"{figures[name][figure]:.1%}" for figure in ("miou", "overall_accuracy")))
    console.print(table)


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
