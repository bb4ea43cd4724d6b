"""The command line: one verb a function; errors become one message and an exit code."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Literal

from cyclopts import CycloptsError, UnknownOptionError

import flows.cli.archive_verbs
import flows.cli.model_verbs
import flows.cli.rig_verbs
import flows.cli.schedule_verbs  # noqa: F401 - each registers its verbs
from flows.cli.app import GOES_ON, AsJson, OutFile, app, parse_numbers, parse_wholes, say, split_list, stderr
from flows.terminal.cache_places import place_caches
from flows.terminal.shown_text import print_json
from flows.terminal.termination import EXIT_CODE as TERMINATED
from flows.terminal.termination import Terminated, refusal_words, terminable
from pipeline.errors import PipelineError, SettingsError

INTERRUPTED = 130


@app.command
def tradeoff(
    stage: str | None = None,
    *,
    out: OutFile = Path("tradeoff"),
    repeats: int = 5,
    seed: int = 0,
    as_json: AsJson = False,
) -> int:
    """Measure what accuracy costs in time, for STAGE or for every stage that has a choice.

    Parameters
    ----------
    stage
        rectify, plan, simulate, segment or store; all without one.
    out
        Folder for tradeoff.json and tradeoff.png.
    repeats
        Rounds in which every setting is timed once.
    seed
        Of the scenes that are measured on.
    """
    from flows.tradeoff.command import run_tradeoff

    content = run_tradeoff(stage, out, repeats, seed, stderr)
    if as_json:
        print_json(content)
    return 0


@app.command
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
    factor: int = 4,
    columns: int = 24,
    preset: Literal["two-scale", "paper", "dense", "upsampled", "coarser"] = "two-scale",
    positions: Literal["2d", "paper"] = "2d",
    init: Path | None = None,
    dim: int = 128,
    layers: int = 4,
    heads: int = 4,
    mlp_ratio: int = 3,
    crop: int | None = None,
    batch: int = 4,
    labels: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    train_mask: str | None = None,
    mask_classes: str | None = None,
    as_json: AsJson = False,
) -> int:
    """Train weights on DATASET: `farm` (`farm@2`), a folder of labelled scenes, or one scene file.

    The state of the run is kept beside the weights, in OUT.checkpoint: the same command goes on where it was stopped.
    `spectralzoom evaluate` then says how good the weights are on scenes that they were not trained on.

    Parameters
    ----------
    dataset
        `farm` (`farm@2`), a folder with images, labels and a scene.toml, or a file.
    out
        File of weights to write (.safetensors).
    hold_out
        Names of scenes never to be trained on, with commas: 059,060. The split is kept in the weights.
    validation
        How many scenes to keep from training, for the figures at its end; by default 3 of the farm, one in eight of a
        folder, 4 at most.
    seed
        Of all that is drawn by chance: first weights, crops, noise.
    steps
        Training ends after so many steps or after --minutes, whichever comes first; the learning rate falls with it.
    minutes
        The longest that the steps may take; looking at the scenes before and validating after come on top.
    scenes
        How many scenes of the built-in farm, on days from April to October; 48 by default.
    patch
        Size of a patch [px]; by default 16 for the farm, 8 to 32 for files, by their size.
    factor
        How many times coarser the coarse pass is than the fine one.
    columns
        How many numbers a pixel's spectrum is brought to, whatever bands a camera has.
    preset
        Which network: `two-scale`, what surveys are made with, or a control to set beside it, with evaluate --control:
        `paper`, the network of the paper; `dense`, one of ours that reads all of the scene finely, without a coarse
        pass; `upsampled`, the same given the coarse pass alone; `coarser`, the same given a grid coarser by 2.
    positions
        How patches are told their places: `2d`, by row and column, or `paper`, by one running number.
    init
        Weights to begin from: a vision transformer of timm or DeiT, a Segmenter checkpoint with its variant.yml beside
        it, or weights that this command made. What is taken is said, and kept in the weights.
    dim
        Width of the transformer, the numbers that a patch becomes; 192 and 384 are those of ViT-Tiny and ViT-Small.
    layers
        Layers of the transformer.
    heads
        Heads of its attention; --dim must be divisible by them.
    mlp_ratio
        How many times wider the middle of its MLPs is.
    crop
        Size of the crops [px]; by default 256 for the farm, 384 for files, whole scenes for the paper's network.
    batch
        Crops a step; half as many in the last 30 % of the run, where crops have twice the area if scenes are large
        enough.
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
    from flows.training.command import run_train
    from flows.training.train import TrainRequest, usual_crop
    from models.training.train import TrainingSettings

    size = crop if crop is not None else usual_crop(dataset, preset)
    choices = {
        "labels": labels,
        "bands": parse_wholes(bands, "--bands"),
        "wavelengths": parse_numbers(wavelengths, "--wavelengths"),
        "train_mask": train_mask,
        "mask_classes": parse_wholes(mask_classes, "--mask-classes"),
    }
    request = TrainRequest(
        dataset,
        out,
        split_list(hold_out),
        validation,
        scenes,
        patch,
        factor,
        columns,
        positions=positions,
        preset=preset,
        tokens={"dim": dim, "layers": layers, "heads": heads, "mlp_ratio": mlp_ratio},
        init=init,
        choices=choices,
        settings=TrainingSettings(steps=steps, minutes=minutes, seed=seed, crop=size, batch=batch),
    )
    record = run_train(request, stderr)
    if as_json:
        print_json(record)
    return 0


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code; an error that the user should read is one message on stderr."""
    # Read when numpy is first imported, which the verbs do. Split among threads, sums are rounded otherwise: the raw
    # light behind one key, and so the receipt of one seed, would differ with the number of cores.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    with terminable(last=arguments is None):
        sys.exit(_run(sys.argv[1:] if arguments is None else arguments))


def _run(arguments: list[str]) -> int:
    """Run the verb; gives the exit code, once what went wrong has been said."""
    try:
        place_caches()  # read when numba and matplotlib are first imported
        if next(iter(arguments), "") in ("rig", "--help", "-h") or not {*arguments[:1]} & {*app}:
            import flows.cli.survey_verbs  # noqa: F401 - numpy and the declared settings; other verbs do without
        code = app(arguments, result_action="return_value", exit_on_error=False, print_error=False)
    except CycloptsError as error:
        say(_usage(error))
        return SettingsError.exit_code
    except PipelineError as error:
        say(str(error))
        return error.exit_code
    except KeyboardInterrupt as error:
        what, code = ("terminated", TERMINATED) if isinstance(error, Terminated) else ("interrupted", INTERRUPTED)
        goes_on = "; the same command goes on from here" if next(iter(arguments), "") in GOES_ON else ""
        stderr.print(f"{what}{goes_on}", highlight=False)
        return code
    except BrokenPipeError:
        return 1
    except Exception as error:
        if (refused := refusal_words(error)) is not None:
            say(refused)
            return 1
        say(f"{type(error).__name__}: {error}; this is a defect of SpectralZoom: please report {_keep_traceback()}")
        return 1
    return code if isinstance(code, int) else 0


def _usage(error: CycloptsError) -> str:
    """What was wrong with the words of a command, and where its right ones stand."""
    from flows.settings.survey_settings import REPLACED

    what = str(error).partition(" Available commands:")[0]  # cut off in the middle: the help has them all
    verb = " ".join(("spectralzoom", *(error.command_chain or ())))
    if isinstance(error, UnknownOptionError):
        word = (error.token.keyword or error.token.value).partition("=")[0]
        gone = REPLACED.get(word.removeprefix("--"))
        what = what if gone is None else f"Unknown option: {word}; {gone}"
    return f"{what.rstrip('.')}; see {verb} --help"


def _keep_traceback() -> Path:
    """Write the traceback where it can be sent from, instead of showing it."""
    with tempfile.NamedTemporaryFile("w", prefix="spectralzoom-", suffix=".log", delete=False) as file:
        traceback.print_exc(file=file)
    return Path(file.name)


if __name__ == "__main__":
    main()
