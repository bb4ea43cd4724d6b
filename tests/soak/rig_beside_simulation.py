"""A whole survey through an emulated rig in processes of their own, and the simulated one of the same scene beside it.

The rig is `spectralzoom rig emulate` behind a pty and sockets, checked by `rig check` first. The surveys share scene,
seed, effects and budget: their raw lines and their maps are to be equal, bit for bit.
"""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from tests.faults.fault_table import Clock, Row
from tests.faults.nursery import ROOT

SIZE, QUICK_SIZE = "256x256", "128x128"
QUICK_BANDS = ",".join(map(str, range(8, 264, 16)))
SPEED, BUDGET, SEED = 10, "0.8", "7"
BEGUN_WITHIN_S, ENDED_WITHIN_S = 120.0, 30.0
SURVEY = ("survey", "--budget", BUDGET, "--keep", "raw", "--no-controls", "--engine", "plain", "--json")


@dataclass(frozen=True)
class Surveyed:
    """One survey: its archive and its receipt."""

    archive: Path
    receipt: dict[str, Any]

    def sweeps(self, product: str) -> dict[str, zarr.Array[Any]]:
        """Raw numbers (line, sample, band) of a capture's sweeps, opened with zarr alone."""
        folder = self.archive / self.receipt["products"][product]
        return {path.stem: zarr.open_array(path / "dn", mode="r") for path in sorted(folder.glob("*.zarr"))}

    def hash_of(self, product: str) -> str:
        """SHA-256 of all values of a product, opened with xarray alone."""
        found = hashlib.sha256()
        with xr.open_zarr(self.archive / self.receipt["products"][product], consolidated=False) as opened:
            for name in sorted(opened.variables):
                found.update(np.ascontiguousarray(opened[name].values).tobytes())
        return found.hexdigest()[:16]


def rows(quick: bool) -> list[Row]:
    """Both surveys, and whether they are equal."""
    clock = Clock()
    scene = ["--scene", "farm", "--size", QUICK_SIZE if quick else SIZE, "--seed", SEED]
    scene += ["--bands", QUICK_BANDS] if quick else []
    with tempfile.TemporaryDirectory(prefix="survey-rig-") as name:
        folder = Path(name)
        with emulated(folder / "emulated.toml", scene) as (rig, process):
            checked = command("rig", "check", str(rig))
            print(checked.stdout, flush=True)
            observation = survey(folder / "rig", str(rig), "--visit", "first")
        simulated = survey(folder / "simulated", *scene)
        found = [_of_check(checked), _of_lines(observation, simulated, clock.seconds)]
        code = process.returncode
        end = Row("the emulated rig", "told to end as by Ctrl-C", 1, "exit code 0", f"exit code {code}", code == 0, 0.0)
        maps = [_of_hashes(observation, simulated, product) for product in ("mosaic", "class_map")]
        return [*found, *maps, end]


@contextmanager
def emulated(file: Path, scene: Sequence[str]) -> Iterator[tuple[Path, subprocess.Popen[bytes]]]:
    """Have a rig, and the settings of a survey of it, while the block runs; then it is told to end, as by Ctrl-C."""
    words = [sys.executable, "-m", "flows.cli.main", "rig", "emulate", *scene, "--speed", str(SPEED)]
    process = subprocess.Popen([*words, "--out", str(file)], cwd=ROOT, stdout=subprocess.DEVNULL)
    try:
        end = time.monotonic() + BEGUN_WITHIN_S
        while not file.exists() or "[rig]" not in file.read_text():
            if process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"the emulated rig did not begin (exit code {process.poll()})")
            time.sleep(0.05)
        yield file, process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(ENDED_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def command(*words: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; progress goes on to stderr."""
    print(f"  {' '.join(words)}", file=sys.stderr, flush=True)
    command_line = [sys.executable, "-m", "flows.cli.main", *words]
    return subprocess.run(command_line, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)


def survey(archive: Path, *words: str) -> Surveyed:
    """Survey into an archive."""
    done = command(SURVEY[0], *words, *SURVEY[1:], "--out", str(archive))
    if done.returncode != 0:
        raise RuntimeError(f"the survey ended with {done.returncode}: {done.stdout}")
    return Surveyed(archive, json.loads(done.stdout))


def _of_check(checked: subprocess.CompletedProcess[str]) -> Row:
    mended = "nothing to mend" in checked.stdout
    what, wanted = "on the emulated rig, by the file that it wrote", "exit code 0, nothing to mend"
    came = f"exit code {checked.returncode}{', nothing to mend' if mended else ''}"
    return Row("rig check", what, 1, wanted, came, checked.returncode == 0 and mended, 0.0)


def _of_lines(one: Surveyed, other: Surveyed, seconds: float) -> Row:
    lines, odd = 0, 0
    for product in ("raw_coarse", "raw_fine"):
        seen, wanted = one.sweeps(product), other.sweeps(product)
        for name in seen.keys() | wanted.keys():
            there = name in seen and name in wanted and seen[name].shape == wanted[name].shape
            count = max(found[name].shape[0] for found in (seen, wanted) if name in found)
            lines += count
            odd += (
                int((np.asarray(seen[name][:]) != np.asarray(wanted[name][:])).any(axis=(1, 2)).sum())
                if there
                else count
            )
    what, came = "coarse and fine, rig beside simulated", f"{odd} of {lines} lines differ"
    return Row("raw lines", what, lines, "equal bit for bit", came, odd == 0, seconds)


def _of_hashes(one: Surveyed, other: Surveyed, product: str) -> Row:
    seen, wanted = one.hash_of(product), other.hash_of(product)
    return Row(product.replace("_", " "), "rig beside simulated, SHA-256", 1, wanted, seen, seen == wanted, 0.0)
