"""Verbs on weights: train them, say how good they are, and what accuracy costs in time."""

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
    """Measure what accuracy costs in time, or in bytes, for STAGE or for every stage that has a choice.

    Parameters
    ----------
    stage
        rectify, segment, simulate, store or survey; all without one.
    scene
        A labelled scene in place of a farm: for segment, whose pixels are taken as they are, for survey, at which the
        simulated rig looks, and for store, a cube of raw numbers. Without a stage segment and survey.
    weights
        Weights that know its classes; for store they may be missing, and no map is drawn.
    out
        Folder for tradeoff.json and tradeoff.png.
    repeats
        Rounds in which every setting is timed once; without it 5, for store 1.
    seed
        Of the scenes that are measured on.
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
    init: Path | None = None,
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

    The state of the run is kept beside the weights, in OUT.checkpoint: the same command goes on where it was stopped.
    `spectralzoom evaluate` then says how good the weights are on scenes that they were not trained on.

    Parameters
    ----------
    dataset
        `farm` (`farm@2`), `scouting` (`scouting@1`), both with a comma between them, a folder of images with their
        labels (`init` writes a scene.toml for it), or a file.
    out
        File of weights to write (.safetensors).
    hold_out
        Names of scenes never to be trained on, with commas: 059,060. The split is kept in the weights.
    validation
        How many scenes to keep from training, for the figures at its end; by default 3 of a built-in scene, one in
        eight of a folder, 4 at most.
    seed
        Of all that is drawn by chance: first weights, crops, noise.
    steps
        Training ends after so many steps or after --minutes, whichever comes first; the learning rate falls with it.
    minutes
        The longest that the steps may take; looking at the scenes before and validating after come on top.
    scenes
        How many built-in scenes, on days from April to October (`scouting`: May to July); 48 by default.
    patch
        Size of a patch [px]; by default 16 for the farm, 8 to 32 for files, by their size.
    width
        Channels of the full network at a patch's own pixels.
    overview_width
        Channels of the overview, which reads every pixel.
    columns
        How many numbers a pixel's spectrum is brought to, whatever bands a camera has.
    init
        Weights to begin from, which this command made. What is taken is said, and kept in the weights.
    train_temporal
        Weights to train a reader of prior maps for, and nothing else: it weighs what earlier visits left against a
        later one. OUT has the weights with it, and surveys with --prior use it. It takes --scenes, --steps, --minutes,
        --seed and --validation, and continues where it was stopped. It needs 4 GB; reading the training scenes takes
        half an hour on top of --minutes.
    fit_ood
        Weights to fit the detector of unknown pixels for, and nothing else: it reads the scenes of their training
        again, which DATASET has to be. OUT has the weights with it; surveys call pixels unknown that are unlike all of
        them. New weights have it from their training, if scenes were kept for validation.
    dim
        Width of the transformer, the numbers that a patch becomes.
    layers
        Layers of the transformer.
    heads
        Heads of its attention; --dim must be divisible by them.
    mlp_ratio
        How many times wider the middle of its MLPs is.
    crop
        Size of the crops [px]; by default 256 for the farm, 384 for files.
    batch
        Crops a step; half as many in the last 30 % of the run, where crops have twice the area if scenes are large
        enough.
    min_exposure_ms
        Shortest exposure that the weights are to read: crops are shown with exposures from here to 100 ms, and lines 1,
        2 or 4 px apart; where scenes are kept for validation the file then has a record of uniform scans on them, by
        which `survey --seconds` plans.
    device
        Where the network computes: `cpu`, `cuda`, `mps`, or `auto`, the first of the last two that torch can use here,
        else the processor.
    labels
        For one scene: the file of its labels.
    bands
        For one scene: numbers of the bands to use, from 0, with commas.
    wavelengths
        For one scene: wavelengths of its bands [nm], with commas.
    train_mask
        For one scene: an image of its size that says where to train; 0 is nowhere.
    mask_classes
        For one scene whose mask numbers classes in another way: the label file's class of its number 1, 2, ..., with
        commas.
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
            init=init,
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
    """Judge WEIGHTS on the frames of DATASET that they were not trained on: accuracy, intervals, placement, costs.

    With --out, frames that were judged are kept there: the same command goes on where it was stopped.

    `evaluate ARCHIVE RUN`, without weights, adds its accuracy to a run that was published without; of the flags below
    it takes --labels, --controls and --json.

    Parameters
    ----------
    dataset
        `farm`, `scouting`, a folder of labelled scenes, or one scene file; with RUN, an archive.
    run
        A run of the archive: its name, `latest` or `previous`. `evaluate archive/runs/NAME` is the same.
    weights
        A file of weights. Several are seeds of one training, or of frames left out in turn: each frame is judged by
        those that never saw it.
    out
        Folder for evaluation.json and its plot, evaluation.png.
    fractions
        Fractions of the patches to read in detail, with commas; 0.05,0.1,0.15,0.2,0.35 by default. No patch
        (none) and every patch (all) are always tried.
    policies
        Ways to choose the patches, with commas; gain,entropy,sobel,random by default. The oracle, which chooses by the
        labels, is always there.
    frames
        Names of the frames to judge on, with commas; all by default.
    scenes
        How many built-in scenes; 4 by default.
    seed
        Of noise, random placements and the bootstrap.
    draws
        How often frames are drawn anew for the intervals (bootstrap).
    labels
        For one scene, or a run: the file of its labels.
    bands
        For one scene: numbers of the bands to use, from 0, with commas.
    wavelengths
        For one scene: wavelengths of its bands [nm], with commas.
    device
        Where the networks of WEIGHTS compute: `cpu`, `cuda`, `mps`, or `auto`, the first of the last two that torch can
        use here, else the processor.
    controls
        For a run: also judge other placements of the same number of patches; as its survey was asked for by default.
    """
    flags = {name: value for name, value in locals().items() if name not in ("dataset", "run")}
    address = _run_address(dataset, run, given=bool(weights))
    if address is not None:
        return _evaluate_run(*address, flags)
    if controls is not None:
        raise SettingsError("--controls is for a run of an archive; leave it out where weights are judged")
    choices = {
        "labels": labels,
        "bands": parse_wholes(bands, "--bands"),
        "wavelengths": parse_numbers(wavelengths, "--wavelengths"),
    }
    given = parse_numbers(fractions, "--fractions")
    request = EvaluateRequest(
        dataset,
        weights,
        out,
        FRACTIONS if given is None else tuple(given),
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


def _run_address(dataset: str, run: str | None, *, given: bool) -> tuple[str, str] | None:
    """Archive and run, where a run is to be judged; None where weights are (SettingsError: neither can be meant)."""
    if run is not None:
        return dataset, run
    if given:
        return None
    found = re.fullmatch(r"(.+)/runs/([^/]+)/?", dataset)
    if found is None:
        raise SettingsError(
            f"evaluate {dataset}: give --weights FILE to judge weights on this data set, or a run of this archive, such"
            f" as evaluate {dataset} latest, to judge its map"
        )
    return found[1], found[2]


def _evaluate_run(archive: str, run: str, flags: Mapping[str, Any]) -> int:
    """Judge the map of a run; ``flags`` are all that `evaluate` has, of which some are for weights alone."""
    usual = inspect.signature(evaluate).parameters
    for name, value in flags.items():
        if name not in ("labels", "controls", "as_json") and value != usual[name].default:
            raise SettingsError(
                f"--{name.replace('_', '-')} is for weights that are judged on a data set; the run {run} is judged as "
                "it was surveyed: leave it out"
            )
    receipt = run_judge(archive, run, stderr, controls=flags["controls"], labels=flags["labels"])
    if flags["as_json"]:
        print_json(receipt)
    return 0
