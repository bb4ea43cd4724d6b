"""What `spectralzoom train` shows: progress with the time left, and the figures at the end."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from flows.terminal.progress import StageProgress
from flows.training.train import TrainRequest, print_start, train_weights
from pipeline.errors import SettingsError


def run_train(request: TrainRequest, console: Console) -> dict[str, Any]:
    """Train with a progress bar on ``console``; give the record kept in the weights."""
    _check_counts(request)
    request = replace(request, command=_command())
    last = ""
    with StageProgress(console) as progress:

        def report(what: str, done: float, figure: str) -> None:
            nonlocal last
            if last not in ("", what):
                progress.show(last, 1.0, ended=True)
            last = what
            progress.show(what, done, figure)

        record = train_weights(request, report)
        progress.show(last, 1.0, ended=True)
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
    if request.positions == "paper" and request.preset not in ("two-scale", "paper"):
        raise SettingsError(
            f"--positions paper is not for --preset {request.preset}, which reads one scale; leave it out"
        )


def _command() -> str:
    """The command without folders: a machine's paths do not belong in weights."""
    words = [Path(word).name if "/" in word else word for word in sys.argv[1:]]
    return shlex.join(["spectralzoom", *words])


def _print_figures(record: dict[str, Any], request: TrainRequest, console: Console) -> None:
    out = request.out
    console.print(f"weights: {out} ({out.stat().st_size / 1e6:.1f} MB), {record['training']['steps']} steps")
    figures = record["validation"]
    if figures is None:
        given = "--weights" if request.preset == "two-scale" else "--weights OTHERS --control"
        console.print(
            "no scene was kept for validation; to judge the weights on scenes that they were not trained on: "
            f"spectralzoom evaluate {request.dataset} {given} {out}",
            soft_wrap=True,
            highlight=False,
        )
        return
    title = f"{figures['scenes']} scene{'s' if figures['scenes'] > 1 else ''} kept for validation"
    caption = f"none: the coarse pass alone; all: fine everywhere; else fine at {figures['share_of_seats']:.0%}"
    table = Table("placement", "mIoU", "overall", title=title, caption=caption)
    for name in ("none", "random", "sobel", "entropy", "gain", "all"):
        if name in figures:  # a control has some of them
            table.add_row(name, *(f"{figures[name][figure]:.1%}" for figure in ("miou", "overall_accuracy")))
    console.print(table)
