"""The command line: one verb a function; errors become one message and an exit code."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import CycloptsError, Parameter

import flows.archive_verbs  # noqa: F401 - registers its verbs
from flows.app import GOES_ON, app, parse_numbers, parse_wholes, say, split_list, stderr
from pipeline.errors import PipelineError, SettingsError


@app.command
def survey(
    settings: Path | None = None,
    *,
    scene: str | None = None,
    labels: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    source: str | None = None,
    out: str | None = None,
    budget: str | None = None,
    policy: str | None = None,
    mask: str | None = None,
    weights: str | None = None,
    rounds: str | None = None,
    seed: str | None = None,
    effects: str | None = None,
    controls: bool | None = None,
    engine: str | None = None,
    memory: str | None = None,
    scheduler: str | None = None,
    workers: str | None = None,
    kernel: str | None = None,
    pointing_px: str | None = None,
    size: str | None = None,
    exposure_ms: str | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Survey a field: a coarse look at everything, then a fine look where it changes the map.

    Parameters
    ----------
    settings
        A survey's TOML file; flags win over it. Without one, flags and defaults alone.
    scene
        `farm` (built in), or an image or cube file: PNG, JPEG, GeoTIFF, .npy, .mat.
    labels
        File of class colours or numbers on the scene's pixels; accuracy is reported then.
    bands
        Bands of the file (or of the farm's 270) to use, from 0: 0,1
    wavelengths
        Their centre wavelengths [nm]: 660,800
    source
        `sim`, the simulated rig.
    out
        Archive: a folder, or s3://bucket/prefix; `archive` by default.
    budget
        Seconds of coarse and fine capture over those of the full scan, above 0 and at most 1; 0.5 by default.
    policy
        Where to look twice: entropy, sobel, random or mask.
    mask
        Image of where to look twice, for the policy mask.
    weights
        Model weights (.safetensors); those for `farm` are built in.
    rounds
        How often to look again; 1.
    seed
        Of the scene `farm` and of all noise.
    effects
        auto, all, none, or names with commas: slit,smear,throughput,shot,read
    controls
        Also judge other placements of the same number of seats (needs labels).
    engine
        `prefect`, or `plain` where no server can start.
    memory
        Sizes the blocks in which the controls scan the whole field: 4GiB by default.
    scheduler
        Who makes tiles and reads regions: `threads`, `processes`, or a dask scheduler elsewhere, tcp://host:port
    workers
        Blocks at a time; one a core by default.
    kernel
        How lines are read between samples: catmull-rom (default), bilinear, or nearest, which mixes no spectra.
    pointing_px
        How far off the mirror may point [px]; above 0 sweeps overlap by more and their seams are registered.
    size
        Of the scene `farm`, width x height: 1280x1024
    exposure_ms
        Exposure of a line.
    as_json
        Print the receipt as JSON on stdout.
    """
    from flows.settings import load_settings
    from flows.survey_command import run_survey

    flags = {
        "scene": scene, "labels": labels, "bands": bands, "wavelengths": wavelengths, "source": source, "out": out,
        "budget": budget, "policy": policy, "mask": mask, "weights": weights, "rounds": rounds, "seed": seed,
        "effects": effects, "controls": controls, "engine": engine, "memory": memory, "kernel": kernel,
        "pointing_px": pointing_px, "size": size, "scheduler": scheduler, "workers": workers,
        "camera.exposure_ms": exposure_ms,
    }  # fmt: skip
    published = run_survey(load_settings(settings, flags), stderr)
    if as_json:
        from flows.receipt import to_json

        sys.stdout.write(to_json(published.receipt))
    return 0


@app.command
def plan(
    settings: Path | None = None,
    *,
    scene: str | None = None,
    labels: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    out: str | None = None,
    budget: str | None = None,
    policy: str | None = None,
    mask: str | None = None,
    weights: str | None = None,
    seed: str | None = None,
    effects: str | None = None,
    controls: bool | None = None,
    scheduler: str | None = None,
    workers: str | None = None,
    kernel: str | None = None,
    pointing_px: str | None = None,
    size: str | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Tell what a survey would run: what is stored, what is to be made and why, and about how long it takes.

    Nothing is captured or written. Give the settings that you would give to `survey`.

    Parameters
    ----------
    settings
        A survey's TOML file; flags win over it.
    scene
        `farm` (built in), or an image or cube file.
    labels
        File of class colours or numbers on the scene's pixels.
    bands
        Bands to use, from 0: 0,1
    wavelengths
        Their centre wavelengths [nm]: 660,800
    out
        Archive: a folder, or s3://bucket/prefix; `archive` by default. It need not be there yet.
    budget
        Seconds of coarse and fine capture over those of the full scan; 0.5 by default.
    policy
        Where to look twice: entropy, sobel, random or mask.
    mask
        Image of where to look twice, for the policy mask.
    weights
        Model weights (.safetensors).
    seed
        Of the scene `farm` and of all noise.
    effects
        auto, all, none, or names with commas.
    controls
        Also judge other placements of the same number of seats (needs labels).
    scheduler, workers
        As for `survey`; nothing is started.
    kernel
        How lines are read between samples: catmull-rom, bilinear or nearest.
    pointing_px
        How far off the mirror may point [px].
    size
        Of the scene `farm`, width x height: 1280x1024
    as_json
        Print the plan as JSON on stdout.
    """
    from flows.forecast_command import run_plan
    from flows.settings import load_settings

    flags = {
        "scene": scene, "labels": labels, "bands": bands, "wavelengths": wavelengths, "out": out, "budget": budget,
        "policy": policy, "mask": mask, "weights": weights, "seed": seed, "effects": effects, "controls": controls,
        "kernel": kernel, "pointing_px": pointing_px, "size": size, "scheduler": scheduler, "workers": workers,
    }  # fmt: skip
    return run_plan(load_settings(settings, flags), as_json=as_json)


@app.command
def tradeoff(
    stage: str | None = None,
    *,
    out: Annotated[Path, Parameter(name=("--out", "-o"))] = Path("tradeoff"),
    repeats: int = 5,
    seed: int = 0,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Measure what accuracy costs in time, for STAGE or for every stage that has a choice.

    Parameters
    ----------
    stage
        rectify, plan or store; all without one.
    out
        Folder for tradeoff.json and tradeoff.png.
    repeats
        Rounds in which every setting is timed once.
    seed
        Of the scenes that are measured on.
    as_json
        Print the figures as JSON on stdout.
    """
    from flows.tradeoff_command import run_tradeoff

    content = run_tradeoff(stage, out, repeats, seed, stderr)
    if as_json:
        print(json.dumps(content, indent=2))
    return 0


@app.command
def train(
    dataset: str,
    *,
    out: Annotated[Path, Parameter(name=("--out", "-o"))],
    hold_out: str | None = None,
    validation: int | None = None,
    seed: int = 0,
    steps: int = 2000,
    minutes: float = 36.0,
    scenes: int | None = None,
    patch: int | None = None,
    factor: int = 4,
    columns: int = 24,
    positions: Literal["2d", "paper"] = "2d",
    crop: int | None = None,
    batch: int = 4,
    labels: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    train_mask: str | None = None,
    mask_classes: str | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Train weights on DATASET: `farm`, a folder of labelled scenes, or one scene file.

    Parameters
    ----------
    dataset
        `farm`, a folder with images, labels and a scene.toml, or a file.
    out
        File of weights to write (.safetensors).
    hold_out
        Names of scenes never to be trained on, with commas: 059,060. The split is kept in the weights.
    validation
        How many scenes to keep for the figures at the end; by default one in eight, 4 at most.
    seed
        Of the first weights, crops and noise.
    steps, minutes
        Training ends with whichever comes first; the learning rate follows. Looking and validating come on top.
    scenes
        How many scenes of the built-in farm; 24 by default.
    patch, factor, columns
        Patch size [px], how many times coarser the coarse pass is, and spectral columns.
    positions
        How tokens are told their places: `2d`, or the paper's one-dimensional numbers.
    crop, batch
        Size of the crops [px] and crops a step.
    labels, bands, wavelengths
        For one scene: its labels, bands to use (from 0) and their wavelengths [nm].
    train_mask, mask_classes
        For one scene: an image of where to train (0 is nowhere), and the class number that each of its numbers means.
    as_json
        Print the weights' record as JSON on stdout.
    """
    from flows.train import FARM_CROP, FRAME_CROP, TrainRequest
    from flows.train_command import run_train
    from models.training import TrainingSettings

    size = crop if crop is not None else FARM_CROP if dataset == "farm" else FRAME_CROP
    choices = {
        "labels": labels,
        "bands": parse_wholes(bands, "--bands"),
        "wavelengths": parse_numbers(wavelengths, "--wavelengths"),
        "train_mask": train_mask,
        "mask_classes": parse_wholes(mask_classes, "--mask-classes"),
    }
    request = TrainRequest(
        dataset, out, split_list(hold_out), validation, scenes, patch, factor, columns, positions=positions,
        choices=choices, settings=TrainingSettings(steps=steps, minutes=minutes, seed=seed, crop=size, batch=batch),
    )  # fmt: skip
    record = run_train(request, stderr)
    if as_json:
        print(json.dumps(record, indent=2))
    return 0


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code; an error that the user should read is one message on stderr."""
    # Read when numpy is first imported, which the verbs do. Split among threads, sums are rounded otherwise: the raw
    # light behind one key, and so the receipt of one seed, would differ with the number of cores.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    try:
        code = app(arguments, result_action="return_value", exit_on_error=False, print_error=False)
    except CycloptsError as error:
        say(f"{str(error).rstrip('.')}; see spectralzoom --help")
        sys.exit(SettingsError.exit_code)
    except PipelineError as error:
        say(str(error))
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        verb = next(iter(sys.argv[1:] if arguments is None else arguments), "")
        goes_on = "; the same command goes on from here" if verb in GOES_ON else ""
        stderr.print(f"interrupted{goes_on}", highlight=False)
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(1)
    except Exception as error:
        say(f"{type(error).__name__}: {error}; this is a defect of SpectralZoom: please report {_keep_traceback()}")
        sys.exit(1)
    sys.exit(code if isinstance(code, int) else 0)


def _keep_traceback() -> Path:
    """Write the traceback where it can be sent from, instead of showing it."""
    with tempfile.NamedTemporaryFile("w", prefix="spectralzoom-", suffix=".log", delete=False) as file:
        traceback.print_exc(file=file)
    return Path(file.name)


if __name__ == "__main__":
    main()
