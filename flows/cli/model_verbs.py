"""Verbs on weights: how good they are, and what that costs."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flows.cli.app import AsJson, OutFolder, Switch, app, parse_numbers, parse_wholes, split_list, stderr
from flows.terminal.shown_text import print_json
from pipeline.errors import SettingsError


@app.command
def seal(*weights: Path) -> int:
    """Give WEIGHTS of an earlier version the hashes by which damage is told; those that have them are checked.

    Nothing else of a file changes, and nothing that was made with it counts as made with other weights.

    Parameters
    ----------
    weights
        Files of weights.
    """
    from models.weights.files import seal_weights

    if not weights:
        raise SettingsError("seal needs files of weights: spectralzoom seal FILE ...")
    for path in weights:
        done = "sealed" if seal_weights(path) else "sealed already, every tensor as it was written"
        stderr.print(f"{path}: {done}", highlight=False, markup=False, soft_wrap=True)
    return 0


@app.command
def evaluate(
    dataset: str,
    run: str | None = None,
    *,
    weights: Annotated[tuple[Path, ...], Parameter(negative="")] = (),
    out: OutFolder = None,
    shares: str | None = None,
    policies: str | None = None,
    frames: str | None = None,
    scenes: int | None = None,
    seed: int = 0,
    draws: int = 2000,
    timed_frames: int = 2,
    timed_runs: int = 10,
    control: Annotated[tuple[Path, ...], Parameter(negative="")] = (),
    rig: bool = True,
    equal_time: Switch = False,
    pooled: bool = True,
    labels: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    controls: bool | None = None,
    as_json: AsJson = False,
) -> int:
    """Judge WEIGHTS on the frames of DATASET that they were not trained on: accuracy, intervals, placement, costs.

    With --out, frames that were judged are kept there: the same command goes on where it was stopped.

    `evaluate ARCHIVE RUN`, without weights, adds its accuracy to a run that was published without; of the flags below
    it takes --labels, --controls and --json.

    Parameters
    ----------
    dataset
        `farm` (`farm@2`), a folder of labelled scenes, or one scene file; with RUN, an archive.
    run
        A run of the archive: its name, `latest` or `previous`. `evaluate archive/runs/NAME` is the same.
    weights
        A file of weights. Several are seeds of one training, or of frames left out in turn: each frame is judged by
        those that never saw it.
    out
        Folder for evaluation.json, the plots (evaluation.png, rig.png) and pictures of the worst and the best frame.
    shares
        Shares of the seats (patches to look at finely) to try, with commas; 0.05,0.1,0.15,0.2,0.35 by default. No seat
        (none) and every seat (all) are always tried.
    policies
        Ways to choose the seats, with commas; gain,entropy,sobel,random by default. The oracle, which chooses by the
        labels, is always there.
    frames
        Names of the frames to judge on, with commas; all by default.
    scenes
        How many scenes of the built-in farm; 4 by default.
    seed
        Of noise, random placements and the bootstrap.
    draws
        How often frames are drawn anew for the intervals (bootstrap).
    timed_frames
        How many frames to time, and to price the capture of; 0 leaves both out.
    timed_runs
        How often each is timed, after three rounds that are not counted; the median is given.
    control
        Weights of another design to compare with, made by train --preset; repeat it for more. The better of all and a
        dense one is the baseline.
    rig
        Also compare plans of lines at equal capture seconds: ours, evenly spaced blocks and random blocks.
    equal_time
        Also judge each row with the exposure that makes its capture take as long as the full scan.
    pooled
        Of several frames, also judge gain and entropy with one threshold for the scores of all frames, which buys the
        share of the seats of all of them together: bare frames then get fewer, rich ones more.
    labels
        For one scene, or a run: the file of its labels.
    bands
        For one scene: numbers of the bands to use, from 0, with commas.
    wavelengths
        For one scene: wavelengths of its bands [nm], with commas.
    controls
        For a run: also judge other placements of the same number of seats; as its survey was asked for by default.
    """
    address = _run_address(dataset, run, given=bool(weights))
    if address is not None:
        for_weights = {
            "weights": weights,
            "out": out,
            "shares": shares,
            "policies": policies,
            "frames": frames,
            "scenes": scenes,
            "seed": seed,
            "draws": draws,
            "timed-frames": timed_frames,
            "timed-runs": timed_runs,
            "control": control,
            "rig": rig,
            "equal-time": equal_time,
            "pooled": pooled,
            "bands": bands,
            "wavelengths": wavelengths,
        }
        return _evaluate_run(*address, for_weights, controls=controls, labels=labels, as_json=as_json)
    if controls is not None:
        raise SettingsError("--controls is for a run of an archive; weights are judged beside others by --control FILE")
    from flows.evaluate.command import run_evaluate
    from flows.evaluate.request import SHARES, USUAL, EvaluateRequest

    choices = {
        "labels": labels,
        "bands": parse_wholes(bands, "--bands"),
        "wavelengths": parse_numbers(wavelengths, "--wavelengths"),
    }
    given = parse_numbers(shares, "--shares")
    request = EvaluateRequest(
        dataset,
        weights,
        out,
        SHARES if given is None else tuple(given),
        split_list(policies) or USUAL,
        split_list(frames),
        scenes,
        seed,
        draws,
        timed_frames,
        timed_runs,
        control,
        rig,
        equal_time,
        pooled,
        choices,
    )
    run_evaluate(request, stderr, as_json=as_json)
    return 0


def _run_address(dataset: str, run: str | None, *, given: bool) -> tuple[str, str] | None:
    """Archive and run, where a run is to be judged; None where weights are, on a data set.

    Raises
    ------
    SettingsError : neither can be meant.
    """
    from flows.archive.judge_command import split_address

    if run is not None:
        return dataset, run
    if given:
        return None
    address = split_address(dataset)
    if address is None:
        raise SettingsError(
            f"evaluate {dataset}: give --weights FILE to judge weights on this data set, or a run of this archive, such"
            f" as evaluate {dataset} latest, to judge its map"
        )
    return address


def _evaluate_run(
    archive: str,
    run: str,
    for_weights: Mapping[str, object],
    *,
    controls: bool | None,
    labels: str | None,
    as_json: bool,
) -> int:
    from flows.archive.judge_command import JudgeRequest, run_judge

    usual = inspect.signature(evaluate).parameters
    named = [flag for flag, value in for_weights.items() if value != usual[flag.replace("-", "_")].default]
    if named:
        raise SettingsError(
            f"--{named[0]} is for weights that are judged on a data set; the run {run} is judged as it was surveyed:"
            " leave it out"
        )
    receipt = run_judge(JudgeRequest(archive, run, controls, labels), stderr)
    if as_json:
        print_json(receipt)
    return 0
