"""Run `spectralzoom evaluate`: judge weights on frames that they were not trained on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spectralzoom.flows.evaluate.frames import (
    ROLES,
    VALIDATION,
    Candidate,
    Jobs,
    observe_frame,
    open_candidates,
    open_frames,
    sort_frames,
)
from spectralzoom.flows.evaluate.judge import ENDS, Choice, Row, Run, judge_frame, summarise
from spectralzoom.flows.settings.model_flags import EvaluateFlags
from spectralzoom.flows.terminal.figures import DASH, counted, format_count, format_percent, format_points
from spectralzoom.flows.terminal.processes import writing
from spectralzoom.flows.terminal.progress import StageProgress, put_out, show_text, show_warnings, table
from spectralzoom.flows.training.data import Report, TrainingData
from spectralzoom.models.network.machine import choose_device, keep_freed_memory
from spectralzoom.models.weights.files import PLAIN, load_weights
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.storage.whole_files import to_json, write_whole

SHOWN_FRACTION = 0.10  # of the patches: the nearest fraction judged is in the table of classes
NO_HEADLINE = (
    "no mIoU: no frame was held out of the training, which chose by the validation frames; train with some held out:"
    " --hold-out NAMES"
)
CAPTION = (
    "K: fraction of the valid patches. mIoU: of the counts of all frames, mean over the classes of the labels. "
    "overall: fraction of right pixels. ±: standard deviation over weights, else over random draws. "
    "MACs: multiply-adds a frame."
)


def run_evaluate(dataset: str, flags: EvaluateFlags, console: Console, *, as_json: bool = False) -> dict[str, Any]:
    """Judge with progress on ``console``; print the figures as a table or JSON, and write them to the folder."""
    with StageProgress(console) as progress:
        content = evaluate_weights(dataset, flags, progress.show)
    show_warnings(content["warnings"], console)
    put_out(content, print_evaluation, as_json=as_json)
    for line in (*(f"note: {note}" for note in content["data_notes"]), *content["files"]):
        show_text(line, console)
    return content


def evaluate_weights(
    dataset: str, flags: EvaluateFlags, show: Report = lambda what, done, figure: None
) -> dict[str, Any]:
    """Judge weights on every frame of a data set that they were not trained on.

    Raises SettingsError: invalid fractions or weights; SceneError: no frame is left, a named frame has no
    weights left, or a frame has no labels.
    """
    fractions = flags.parts
    if flags.seed < 0:
        raise SettingsError(f"--seed must be at least 0, got {flags.seed}")
    keep_freed_memory()
    candidates = open_candidates(flags.weights)
    if not any(one.described.config.corrected for one in candidates):
        fractions = ()  # every fraction is the same map
    data = open_frames(dataset, flags.frames, flags.scenes, candidates[0].camera, flags.choices())
    if flags.out is not None:
        with writing(flags.out):
            flags.out.mkdir(parents=True, exist_ok=True)  # fails before minutes are spent
    jobs = sort_frames(data, candidates, show, named=bool(flags.frames))
    runs = _judge_frames(flags, fractions, data, candidates, jobs.frames, show)
    content: dict[str, Any] = {
        "warnings": [warning for one in candidates for warning in one.warnings],
        "dataset": data.law,
        "weights": [
            {"file": one.path.name, "key": one.described.key[:16], "frames": list(run)}
            for one, run in zip(candidates, runs, strict=True)
        ],
        "left_out": jobs.left_out,
        "settings": {"fractions": fractions, "seed": flags.seed, "camera": asdict(candidates[0].camera)},
        **_by_role(runs, jobs, candidates, fractions),
        "data_notes": [*data.notes, *jobs.notes],
        "files": [] if flags.out is None else [str(flags.out / "evaluation.json")],
    }
    if flags.out is not None:
        write_whole(flags.out / "evaluation.json", to_json(content))
    return content


def _judge_frames(
    flags: EvaluateFlags,
    fractions: Sequence[float],
    data: TrainingData,
    candidates: Sequence[Candidate],
    frames: Mapping[str, Mapping[int, str]],
    show: Report,
) -> list[dict[str, dict[Choice, Row]]]:
    """Judge every frame by its weights; return the rows of the frames of each of the weights."""
    device, seed = choose_device(flags.device), flags.seed
    loaded = [load_weights(one.path).on(device) for one in candidates]
    runs: list[dict[str, dict[Choice, Row]]] = [{} for _ in candidates]
    for number, (name, judges) in enumerate(frames.items()):
        show("judging frames", number / len(frames), name)
        scene = data.scene(name)
        for at in judges:
            frame = observe_frame(scene, name, loaded[at], candidates[at].camera, seed)
            runs[at][name] = judge_frame(*frame, len(scene.wavelength_nm), loaded[at], fractions, seed)
    show("judging frames", 1.0, f"{len(frames)} frames")
    return runs


def _by_role(
    runs: Sequence[Run], jobs: Jobs, candidates: Sequence[Candidate], fractions: Sequence[float]
) -> dict[str, Any]:
    """Return the figures of the headline, none of validation frames, and ``apart`` those of the other frames.

    ``judges`` are the files with a frame of the headline.
    """
    found: dict[str, dict[str, Any]] = {}
    names, patch = candidates[0].described.class_names, candidates[0].described.config.patch
    for role in ROLES:
        own = [{name: run[name] for name in run if jobs.frames[name][at] == role} for at, run in enumerate(runs)]
        if some := [run for run in own if run]:
            frames = [name for name, roles in jobs.frames.items() if role in roles.values()]
            judges = [one.path.name for one, run in zip(candidates, own, strict=True) if run]
            found[role] = {"frames": frames, "judges": judges, **summarise(some, names, fractions, patch)}
    headline = next((role for role in found if role != VALIDATION), None)
    nothing: dict[str, Any] = {"frames": [], "judges": [], "brief": {}, "rows": [], "support": {}}
    return {"headline": headline, **found.pop(headline or "", nothing), "apart": found}


def print_evaluation(content: dict[str, Any], console: Console) -> None:
    """Print frames and weights, rows of frames apart, accuracy with costs, the classes, and an explanation."""
    weights = content["weights"]
    judges = content["judges"] or [one["file"] for one in weights]
    named = f"{len(judges)} sets of weights" if len(judges) > 1 else judges[0]
    left = f"; left out (training frames): {len(content['left_out'])}" if content["left_out"] else ""
    lines = [_sentence(content["brief"], named, content["headline"]) if content["headline"] else NO_HEADLINE]
    lines += [f"{content['dataset']}: {counted(len(content['frames']), 'frame')}, {named}{left}"]
    if len(weights) > 1:
        lines += [f"  {one['file']}: {', '.join(one['frames']) or 'no frame'}" for one in weights]
    for role, one in content["apart"].items():
        lines += [f"  {role}: mIoU {format_points(one['rows'][-1]['miou'])} of {counted(len(one['frames']), 'frame')}"]
    for line in lines:
        show_text(line, console)
    if content["headline"]:
        console.print(_accuracy(content))
        console.print(_classes(content))
        console.print(escape(CAPTION), soft_wrap=True, style="dim")


def _sentence(brief: dict[str, Any], named: str, headline: str) -> str:
    """Return what to know first: the weights, the best plain classifier, and the cost of each."""
    found = {
        name: f"{format_points(one['miou'])} ({format_count(one['multiply_adds_a_pixel'])} multiply-adds a pixel)"
        for name, one in brief.items()
    }
    peer = f", the best plain classifier of single pixels {found[PLAIN]}" if PLAIN in found else ""
    return f"mIoU, {headline}: {named} {found['weights']}{peer}"


def _accuracy(content: dict[str, Any]) -> Table:
    columns = ("placement", "K", "mIoU", "overall", "average", "kappa", "MACs")
    rows = []
    for row in content["rows"]:
        spread = row["spread"]
        cells = (
            row["policy"],
            format_percent(row["fraction"]),
            format_points(row["miou"]) + ("" if spread is None else f" ±{100 * spread:.1f}"),
            format_points(row["pixel_accuracy"]),
            format_points(row["average_accuracy"]),
            DASH if math.isnan(row["kappa"]) else f"{row['kappa']:.2f}",
            format_count(row["multiply_adds"]),
        )
        rows.append(cells)
    return table(columns, rows, whole=columns[1:])


def _classes(content: dict[str, Any]) -> Table:
    shown = [row for row in content["rows"] if row["policy"] in ENDS]
    first = [row for row in content["rows"] if row["policy"] == content["rows"][1]["policy"]]
    nearest = min(first, key=lambda row: abs(row["fraction"] - SHOWN_FRACTION))
    shown = [shown[0], *([] if nearest in shown else [nearest]), *shown[1:]]
    columns = ("class", "labelled px", *(f"{row['policy']} {format_percent(row['fraction'])}" for row in shown))
    rows = []
    for name, support in content["support"].items():
        cells = []
        for row in shown:
            false = row["false_classes"].get(name)  # pixels of a class that the labels lack
            cells += [format_points(row["per_class_iou"][name]) if false is None else f"{format_count(false)} px false"]
        rows.append([escape(name), format_count(support), *cells])
    return table(columns, rows, title="IoU by class", whole=columns[1:])
