"""What `spectralzoom tradeoff` shows: a table for each stage, and JSON and a plot in a folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

import flows.tradeoff.budget
import flows.tradeoff.line_model
import flows.tradeoff.overlap
import flows.tradeoff.resample
import flows.tradeoff.scan_step
import flows.tradeoff.segment
import flows.tradeoff.simulate
import flows.tradeoff.simulate_bands
import flows.tradeoff.simulate_noise
import flows.tradeoff.simulate_rays
import flows.tradeoff.store
import flows.tradeoff.tie_spacing  # noqa: F401 - each registers its entry
from flows.tradeoff.entries import find_tradeoffs, measure_tradeoff, registered
from flows.tradeoff.plots import draw_tradeoffs
from flows.tradeoff.table import print_tradeoff
from pipeline.errors import ArchiveError, SettingsError


def run_tradeoff(stage: str | None, out: Path, repeats: int, seed: int, console: Console) -> dict[str, Any]:
    """Measure the trade-offs of one stage, or all; write tradeoff.json and .png into ``out`` and print the tables."""
    if repeats < 1:
        raise SettingsError(f"--repeats must be at least 1, got {repeats}")
    if seed < 0:
        raise SettingsError(f"--seed must be 0 or more, got {seed}")
    wanted = find_tradeoffs(stage) if stage else tuple(registered().values())
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)  # before minutes are spent on what cannot be kept
    results = []
    for tradeoff in wanted:
        with console.status(f"measuring {tradeoff.stage}: {tradeoff.knob}"):
            result = measure_tradeoff(tradeoff, repeats=repeats, seed=seed)
        print_tradeoff(result, console)
        results.append(result)
    content = {"tradeoffs": [result.to_dict() for result in results]}
    with _writing(out):
        (out / "tradeoff.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
        draw_tradeoffs(out / "tradeoff.png", results)
    console.print(f"{out / 'tradeoff.json'}\n{out / 'tradeoff.png'}", highlight=False, soft_wrap=True)
    return content


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ArchiveError(f"cannot write to {out}: {error.strerror}; choose another --out") from error
