"""The command line: one verb a function; errors become one message and an exit code."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.console import Console

from pipeline.errors import PipelineError, SettingsError

app = App(name="spectralzoom", help="Survey a field: a coarse look at everything, a fine look where it changes the map.")
stderr = Console(stderr=True)


@app.command
def train(
    dataset: str,
    *,
    out: Annotated[Path, Parameter(name=("--out", "-o"))],
    hold_out: str | None = None,
    validation: int | None = None,
    seed: int = 0,
    steps: int = 2000,
    minutes: float = 40.0,
    scenes: int = 24,
    patch: int | None = None,
    factor: int = 4,
    columns: int = 24,
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
        The run ends with whichever comes first; the learning rate follows.
    scenes
        How many scenes of the built-in farm.
    patch, factor, columns
        Patch size [px], how many times coarser the coarse pass is, and spectral columns.
    crop, batch
        Size of the crops [px] and crops a step.
    labels, bands, wavelengths
        For one scene: its labels, bands to use (from 0) and their wavelengths [nm].
    train_mask, mask_classes
        For one scene: an image of where to train (0 is nowhere), and the class number that each of its numbers means.
    as_json
        Print the weights' record as JSON on stdout.
    """
    from flows.train_command import run_train

    record = run_train(
        dataset, out, stderr,
        hold_out=_split(hold_out), validation=validation, seed=seed, steps=steps, minutes=minutes, scenes=scenes,
        patch=patch, factor=factor, columns=columns, crop=crop, batch=batch,
        choices={
            "labels": labels,
            "bands": None if bands is None else [_whole(text, "--bands") for text in _split(bands)],
            "wavelengths": None if wavelengths is None else [_number(text, "--wavelengths") for text in _split(wavelengths)],
            "train_mask": train_mask,
            "mask_classes": None if mask_classes is None else [_whole(text, "--mask-classes") for text in _split(mask_classes)],
        },
    )  # fmt: skip
    if as_json:
        print(json.dumps(record, indent=2))
    return 0


def _split(text: str | None) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip()) if text else ()


def _number(text: str, flag: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise SettingsError(f"{flag} expects numbers with commas, got {text!r}") from None


def _whole(text: str, flag: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise SettingsError(f"{flag} expects whole numbers with commas, got {text!r}") from None


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code; an error that the user should read is one message on stderr."""
    try:
        code = app(arguments, console=stderr, result_action="return_value")
    except PipelineError as error:
        stderr.print(f"[bold red]error[/]: {error}", highlight=False, soft_wrap=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        stderr.print("interrupted; the same command goes on from here", highlight=False)
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
