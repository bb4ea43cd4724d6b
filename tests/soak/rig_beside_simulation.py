"""Compare a survey through a fake rig, in separate processes, with the simulated survey of the same scene.

`rig check` checks the rig first. The surveys share scene, seed, visit, effects and budget, so their raw lines and their
maps must be equal, bit for bit.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from tests.faults.fault_table import Row
from tests.faults.nursery import ROOT

SIZE, QUICK_SIZE = "256x256", "128x128"
QUICK_BANDS = ",".join(map(str, range(8, 264, 16)))
SURVEY = ("survey", "--budget", "0.8", "--keep", "raw", "--engine", "plain", "--json")
FAKE = 'source = "rig"\nscene = "farm"\n[rig]\nmirror_driver = "fake"\ncamera_driver = "fake"\n'
PRODUCTS = ("raw_coarse", "raw_fine", "mosaic", "class_map")


def rows(quick: bool) -> list[Row]:
    """Return the rows of the rig check and of the comparison of both surveys."""
    scene = ["--size", QUICK_SIZE if quick else SIZE, "--seed", "7", *(("--bands", QUICK_BANDS) if quick else ())]
    with tempfile.TemporaryDirectory(prefix="survey-rig-") as name:
        folder = Path(name)
        (folder / "fake.toml").write_text(FAKE)
        checked = run("rig", "check", str(folder / "fake.toml"), "--move")
        print(checked, flush=True)
        seen = survey(folder / "rig", str(folder / "fake.toml"), *scene, "--visit", "first")
        wanted = survey(folder / "simulated", "--scene", "farm", *scene, "--visit", "first")
    mended = "nothing to mend" in checked
    found = [Row("rig check", "of the fake devices", 1, "nothing to mend", checked.splitlines()[-1], mended)]
    for one in PRODUCTS:
        same = seen[one] == wanted[one]
        found.append(Row(one, "rig beside simulated, SHA-256", 1, wanted[one], seen[one], same))
    return found


def run(*words: str) -> str:
    """Run a command to its end and return its output; progress appears on stderr."""
    print(f"  {' '.join(words)}", file=sys.stderr, flush=True)
    command_line = [sys.executable, "-m", "spectralzoom.flows.cli.main", *words]
    return subprocess.run(command_line, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True).stdout


def survey(archive: Path, *words: str) -> dict[str, str]:
    """Survey into an archive; return the SHA-256 of the values of each product, read with xarray alone."""
    products = json.loads(run(SURVEY[0], *words, *SURVEY[1:], "--out", str(archive)))["products"]
    found = {}
    for one in PRODUCTS:
        folder = archive / products[one]
        digest = hashlib.sha256()
        for path in sorted(folder.glob("*.zarr")) or [folder]:
            with xr.open_zarr(path, consolidated=False) as opened:
                for name in ["dn"] if "dn" in opened else sorted(opened.variables):  # times of lines differ
                    digest.update(np.ascontiguousarray(opened[name].values).tobytes())
        found[one] = digest.hexdigest()[:16]
    return found
