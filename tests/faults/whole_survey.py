"""A survey with every kind of store: effects, two passes, maps on the scene and on the ground, and accuracy.

All files of its archive are compared as they lie on the disk, and all its numbers as the command line and the package
give them, so that nothing here depends on how an archive is written.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray

import spectralzoom
from tests.faults.nursery import Ended, Nursery
from tests.faults.small_survey import SETTINGS, Subject, words
from tests.receipts import comparable

MORE = """
[cost]
reload_s = 0
[pose]
lon_deg = 9.5
lat_deg = 52.1
heading_deg = 25.0
tilt_deg = 50.0
height_m = 1400.0
"""
Numbers = dict[str, str]  # name of a product -> SHA-256 of all that it is read as


@dataclass(frozen=True)
class Whole:
    """An archive of one undisturbed survey, and all that it has and gives; ``out`` is not to be changed."""

    nursery: Nursery
    out: Path
    files: dict[str, str]  # address -> SHA-256 of each file of a store except manifests
    numbers: dict[str, Numbers]  # of each store and the run, by address
    exported: dict[str, str]  # name -> SHA-256 of each file
    receipt: dict[str, Any]

    @property
    def stores(self) -> list[str]:
        """Return the addresses of all stores, also of a cleared one, of which only the manifest is left."""
        return [uri for uri in self.numbers if uri != self.run]

    @property
    def run(self) -> str:
        """Return the address of the run."""
        return next(uri for uri in self.numbers if uri.startswith("runs/"))

    def copy(self, out: Path) -> Path:
        """Copy the archive by links to its files, which must be replaced, not written to."""
        return Path(shutil.copytree(self.out, out, copy_function=os.link))

    def survey(self, out: Path, fault: str | None = None, **arguments: Any) -> Ended:
        """Survey again into an archive."""
        return self.nursery.run(asked(out), fault, **arguments)


def asked(out: Path) -> list[str]:
    """Return the words of the survey into an archive."""
    return [word.replace("camera.toml", "whole.toml") for word in words(out, "--controls")]


def survey_whole(subject: Subject) -> Whole:
    """Make the archive below the subject's folder."""
    nursery, out, exported = subject.nursery, subject.folder / "whole", subject.folder / "whole-exported"
    (subject.folder / "whole.toml").write_text(SETTINGS + MORE)
    for words_ in (asked(out), ["export", str(out), "--out", str(exported)]):
        ended = nursery.run(words_)
        assert ended.code == 0, ended.text
    (receipt,) = (json.loads(path.read_text()) for path in out.glob("runs/*/receipt.json"))
    folders = [*sorted(filter(Path.is_dir, (out / "stages").glob("*/*"))), *(out / "runs").iterdir()]
    numbers = {uri: numbers_of(out, uri) for uri in (folder.relative_to(out).as_posix() for folder in folders)}
    return Whole(nursery, out, stored_files(out), numbers, maps_of(exported), comparable(receipt))


def stored_files(out: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of an archive's stores except manifests, by address."""
    paths = (path for path in (out / "stages").rglob("*") if path.is_file() and path.name != "manifest.json")
    return {path.relative_to(out).as_posix(): digest(path.read_bytes()) for path in paths if path.suffix != ".cleared"}


def descendants(out: Path, uri: str) -> list[Path]:
    """Return the folders of all stores that were made of a store, directly or not."""
    texts = {path.parent: path.read_text(errors="replace") for path in (out / "stages").glob("*/*/manifest.json")}
    found, waiting = set[Path](), [out / uri]
    while waiting:
        key = waiting.pop().name
        new = {folder for folder, text in texts.items() if key in text and folder.name != key} - found
        found |= new
        waiting += new
    return sorted(found)


def numbers_of(out: Path, uri: str, run: str = "latest") -> Numbers:
    """Return the hashes of all that a run's products in one store, or a run's receipt, are read as by the package.

    Raises spectralzoom.Error: something is damaged.
    """
    opened = spectralzoom.open(out)[uri.removeprefix("runs/") if uri.startswith("runs/") else run]
    if uri.startswith("runs/"):
        return {"receipt": digest(json.dumps(opened.receipt, sort_keys=True).encode())}
    found: Numbers = {}
    for name in (name for name, place in opened.receipt["products"].items() if place.startswith(uri)):
        if name.startswith("raw"):
            found |= {f"{name} {sweep}": of_arrays(one) for sweep, one in opened.sweeps.items()}
        elif name.startswith("signal"):
            found |= {f"{name} {sweep}": of_arrays(one.to_dataset(name="value")) for sweep, one in opened.lines.items()}
        elif name in opened.products:
            found[name] = of_arrays(opened.dataset(name))
            found |= {"spectra": of_arrays(opened.mosaic.to_dataset(name="value"))} if name == "mosaic" else {}
    return found


def maps_of(exported: Path) -> dict[str, str]:
    """Return the SHA-256 of the exported images and tables, by name."""
    files = [path for path in exported.glob("*/*") if path.suffix in (".tif", ".csv")]
    return {path.name: digest(path.read_bytes()) for path in files}


def of_arrays(opened: xarray.Dataset) -> str:
    """Return the SHA-256 of all values, dimensions, types and attributes."""
    parts = [repr(sorted(opened.sizes.items())), repr(sorted(opened.attrs.items(), key=str))]
    for name, one in sorted(opened.variables.items(), key=str):
        values = np.asarray(one.values)
        text = repr(values.tolist()).encode() if values.dtype.kind == "O" else values.tobytes()
        parts.append(f"{name} {one.dims} {values.dtype} {sorted(one.attrs.items(), key=str)} {digest(text)}")
    return digest("\n".join(parts).encode())


def digest(content: bytes) -> str:
    """Return a SHA-256 in hex."""
    return hashlib.sha256(content).hexdigest()


def other_receipt(whole: Whole, out: Path) -> list[str]:
    """Return the parts in which the receipt of the newest run beside the first one differs from that."""
    runs = [path for path in (out / "runs").glob("*/receipt.json") if f"runs/{path.parent.name}" != whole.run]
    newest = max(runs, key=lambda path: path.stat().st_mtime_ns)
    found: Mapping[str, Any] = comparable(json.loads(newest.read_text()))
    return [name for name in {**found, **whole.receipt} if found.get(name) != whole.receipt.get(name)]
