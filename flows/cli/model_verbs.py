"""Define the verbs on weights: train, evaluate and tradeoff."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from flows.archive.reprocess_command import run_judge
from flows.cli.app import AsJson, OutFile, OutFolder, parse_numbers, parse_wholes, split_list, stderr
from flows.evaluate.command import run_evaluate
from flows.evaluate.frames import FRACTIONS, USUAL, EvaluateRequest
from flows.terminal.progress import print_json
from flows.tradeoff.command import run_tradeoff
from flows.training.fit_ood import OodRequest, run_measure_ood
from flows.training.train import asked_command, run_train, usual_crop
from flows.training.train_scenes import TrainRequest
from flows.training.train_temporal import JUDGED_LANDS, LANDS, TemporalRequest, run_remember
from models.network.machine import PROCESSOR, Device
from models.training.temporal import TemporalTraining
from models.training.train import TrainingSettings
from pipeline.errors import SettingsError


def tradeoff(
    stage: str | None = None,
    *,
    scene: str | None = None,
    weights: Path | None = None,
    out: OutFile = Path("tradeoff"),
    repeats: int | None = None,
    seed: int = 0,
    as_json: AsJson = False,
) -> int:
    """Measure accuracy against time or bytes, for STAGE or for all stages with a choice.

    Parameters
    ----------
    stage
        rectify, segment, simulate, store or survey. Default: all.
    scene
        Labelled scene instead of a farm: a raster for segment, a scene of the simulated rig for survey, a cube of raw
        numbers for store. Without a stage: segment and survey.
    weights
        Weights for the classes of the scene; optional for store, which then draws no map.
    out
        Folder of tradeoff.json and tradeoff.png.
    repeats
        Rounds that time every setting once. Default: 5, for store 1.
    seed
        Random seed of the scenes.
    """

    content = run_tradeoff(stage, out, repeats, seed, stderr, scene=scene, weights=weights)
    if as_json:
        print_json(content)
    return 0


def train(
    dataset: str,
    *,
    out: OutFile,
    hold_out: str | None = None,
    validation: int | None = None,
    seed: int = 0,
    steps: int = 2000,
    minutes: float = 36.0,
    scenes: int | None = None,
    patch: int | None = None,
    width: int = 20,
    overview_width: int = 8,
    columns: int = 24,
    train_temporal: Path | None = None,
    fit_ood: Path | None = None,
    dim: int = 64,
    layers: int = 3,
    heads: int = 4,
    mlp_ratio: int = 3,
    crop: int | None = None,
    batch: int = 4,
    min_exposure_ms: float = 100.0,
    device: Device = PROCESSOR,
    labels: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    train_mask: str | None = None,
    mask_classes: str | None = None,
    as_json: AsJson = False,
) -> int:
    """Train weights on DATASET: `farm`, `scouting`, a folder of labelled scenes, or one scene file.

    The training saves its state in OUT.checkpoint; the same command resumes it.
    `spectralzoom evaluate` measures the accuracy on scenes that were not used for training.

    Parameters
    ----------
    dataset
        `farm` or `scouting` (with a seed: `farm@2`), both with a comma, a folder of images with labels (`init` writes
        a scene.toml for it), or a file.
    out
        Weights to write (.safetensors).
    hold_out
        Names of scenes to exclude from training, with commas: 059,060. The weights record the split.
    validation
        Number of validation scenes. Default: 3 built-in scenes, or one in eight of a folder, at most 4.
    seed
        Random seed of initial weights, crops and noise.
    steps
        Maximum number of steps; training stops at --steps or --minutes, whichever comes first.
    minutes
        Time limit of the steps [min]; reading scenes and validation are not included.
    scenes
        Number of built-in scenes, on days from April to October (`scouting`: May to July). Default: 48.
    patch
        Size of a patch [px]. Default: 16 for the farm, 8 to 32 for files, by their size.
    width
        Channels of the full network at full resolution.
    overview_width
        Channels of the overview network.
    columns
        Number of spectral features per pixel, for any camera.
    train_temporal
        Weights to which only a temporal reader is added, for surveys with --prior. It takes --scenes, --steps,
        --minutes, --seed and --validation, and resumes. It needs 4 GB of memory, and half an hour for reading the
        scenes besides --minutes.
    fit_ood
        Weights to which only an out-of-distribution detector is added. DATASET must be the data set of their training.
        Surveys then label out-of-distribution pixels `unknown`. Training with validation scenes adds it by default.
    dim
        Token width of the transformer.
    layers
        Number of transformer layers.
    heads
        Number of attention heads; a divisor of --dim.
    mlp_ratio
        Hidden width of the MLPs, as a multiple of --dim.
    crop
        Size of the crops [px]. Default: 256 for the farm, 384 for files.
    batch
        Crops per step; half as many, of twice the area, in the last 30 % of the steps.
    min_exposure_ms
        Shortest exposure [ms]: augments training with simulated noise of exposures up to 100 ms and line spacings of
        1, 2 and 4 px. With validation scenes, the weights record the scan performance, which `survey --seconds` needs.
    device
        Device of the network: `cpu`, `cuda`, `mps`, or `auto` (cuda or mps if available, else cpu).
    labels
        For one scene: label file.
    bands
        For one scene: band numbers to use, counted from 0, with commas.
    wavelengths
        For one scene: centre wavelengths of its bands [nm], with commas.
    train_mask
        For one scene: mask image of the training pixels; 0 excludes a pixel.
    mask_classes
        For one scene: classes of the label file that the mask's numbers 1, 2, ... stand for, with commas.
    """

    choices = {
        "labels": labels,
        "bands": parse_wholes(bands, "--bands"),
        "wavelengths": parse_numbers(wavelengths, "--wavelengths"),
        "train_mask": train_mask,
        "mask_classes": parse_wholes(mask_classes, "--mask-classes"),
    }
    if train_temporal is not None:
        how = TemporalTraining(minutes, steps, seed)
        lands, judged = LANDS if scenes is None else scenes, JUDGED_LANDS if validation is None else validation
        asked = TemporalRequest(dataset, train_temporal, out, lands, judged, settings=how, command=asked_command())
        record = run_remember(asked, stderr)
    elif fit_ood is not None:
        record = run_measure_ood(OodRequest(dataset, fit_ood, out, choices, asked_command()), stderr)
    else:
        size = crop if crop is not None else usual_crop(dataset)
        request = TrainRequest(
            dataset,
            out,
            split_list(hold_out),
            validation,
            scenes,
            patch,
            columns,
            width,
            overview_width,
            tokens={"dim": dim, "layers": layers, "heads": heads, "mlp_ratio": mlp_ratio},
            choices=choices,
            settings=TrainingSettings(
                steps=steps, minutes=minutes, seed=seed, crop=size, batch=batch, darkest_ms=min_exposure_ms
            ),
            device=device,
        )
        record = run_train(request, stderr)
    if as_json:
        print_json(record)
    return 0


def evaluate(
    dataset: str,
    run: str | None = None,
    *,
    weights: Annotated[tuple[Path, ...], Parameter(negative="")] = (),
    out: OutFolder = None,
    fractions: str | None = None,
    policies: str | None = None,
    frames: str | None = None,
    scenes: int | None = None,
    seed: int = 0,
    draws: int = 2000,
    labels: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    controls: bool | None = None,
    device: Device = PROCESSOR,
    as_json: AsJson = False,
) -> int:
    """Evaluate WEIGHTS on the frames of DATASET that they were not trained on: accuracy, intervals, policies, costs.

    With --out, the same command resumes a stopped evaluation.

    `evaluate ARCHIVE RUN`, without weights, adds the accuracy to a published run; it takes only --labels, --controls
    and --json.

    Parameters
    ----------
    dataset
        `farm`, `scouting`, a folder of labelled scenes, one scene file, or an archive with RUN.
    run
        Run of the archive: its name, `latest` or `previous`. `evaluate archive/runs/NAME` is equivalent.
    weights
        Weights; repeat the flag for several seeds or folds. Each frame is evaluated by the weights that were not
        trained on it.
    out
        Folder of evaluation.json.
    fractions
        Fractions of the patches to read at full resolution, with commas. Default: 0.05,0.1,0.15,0.2,0.35; none and all
        are always included.
    policies
        Policies that choose the patches, with commas. Default: gain,entropy,sobel,random; an oracle that uses the
        labels is always included.
    frames
        Names of the frames, with commas. Default: all.
    scenes
        Number of built-in scenes. Default: 4.
    seed
        Random seed of noise, random policy and bootstrap.
    draws
        Bootstrap samples for the intervals.
    labels
        For one scene or a run: label file.
    bands
        For one scene: band numbers to use, counted from 0, with commas.
    wavelengths
        For one scene: centre wavelengths of its bands [nm], with commas.
    device
        Device of the networks: `cpu`, `cuda`, `mps`, or `auto` (cuda or mps if available, else cpu).
    controls
        For a run: also compare other placements of as many patches. Default: as in its survey.
    """
    flags = {name: value for name, value in locals().items() if name not in ("dataset", "run")}
    address = _run_address(dataset, run, weights=bool(weights))
    if address is not None:
        return _evaluate_run(*address, flags)
    if controls is not None:
        raise SettingsError("--controls is for a run of an archive, not for weights; leave it out")
    choices = {
        "labels": labels,
        "bands": parse_wholes(bands, "--bands"),
        "wavelengths": parse_numbers(wavelengths, "--wavelengths"),
    }
    chosen = parse_numbers(fractions, "--fractions")
    request = EvaluateRequest(
        dataset,
        weights,
        out,
        FRACTIONS if chosen is None else tuple(chosen),
        split_list(policies) or USUAL,
        split_list(frames),
        scenes,
        seed,
        draws,
        choices,
        device,
    )
    run_evaluate(request, stderr, as_json=as_json)
    return 0


def _run_address(dataset: str, run: str | None, *, weights: bool) -> tuple[str, str] | None:
    """Return archive and run, or None for an evaluation of weights. Raises SettingsError: neither is given."""
    if run is not None:
        return dataset, run
    if weights:
        return None
    found = re.fullmatch(r"(.+)/runs/([^/]+)/?", dataset)
    if found is None:
        raise SettingsError(
            f"evaluate {dataset}: give --weights FILE to judge weights on this data set, or a run of this archive, such"
            f" as evaluate {dataset} latest, to judge its map"
        )
    return found[1], found[2]


def _evaluate_run(archive: str, run: str, flags: Mapping[str, Any]) -> int:
    """Evaluate the map of a run. Raises SettingsError: ``flags`` has a flag that is for weights only."""
    parameters = inspect.signature(evaluate).parameters
    for name, value in flags.items():
        if name not in ("labels", "controls", "as_json") and value != parameters[name].default:
            raise SettingsError(
                f"--{name.replace('_', '-')} is for weights that are judged on a data set, not for a run; leave it out"
            )
    receipt = run_judge(archive, run, stderr, controls=flags["controls"], labels=flags["labels"])
    if flags["as_json"]:
        print_json(receipt)
    return 0
