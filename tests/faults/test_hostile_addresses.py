"""Addresses that lead out of an archive, in its receipts and manifests and on the command line, are refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import spectralzoom
from tests.faults.hostile_archives import CODES, SECRET, Tries, ended_in_time, readers, tree
from tests.faults.whole_survey import Whole, asked, digest
from tests.storage.small_archive import rewrite

LEADS = (
    "../outside/",
    "stages/../../outside/",
    "stages/segment/../../../outside/",
    "runs/../../outside/",
    "{outside}/",
)
MAPS = ("class_map", "class_probabilities", "mosaic", "attention", "ground_map")
PRODUCTS = (*MAPS, "raw_coarse", "raw_fine", "signal_coarse", "signal_fine")
SPOKEN = ("../../outside", "runs/../../outside", "stages/../../outside", "..", "/", "stages/segment/../../../outside")


@pytest.fixture
def outside(whole: Whole, tmp_path: Path) -> Iterator[Path]:
    """Yield a folder beside an archive with all that could be read from it; nothing in it may change."""
    folder = tmp_path / "outside"
    shutil.copytree(whole.out / whole.run, folder)
    for uri in (
        uri for uri in whole.stores if "/condense" not in uri
    ):  # the names of whose lines are those of raw ones
        for path in (whole.out / uri).glob("*.zarr"):
            shutil.copytree(path, folder / path.name)
    (folder / "secret").write_text(SECRET)
    before = tree(folder)
    yield folder
    assert tree(folder) == before


def forge(folder: Path, **facts: Any) -> None:
    """Replace the manifest of a store or run by one with other facts and a valid seal."""
    manifest = folder / "manifest.json"
    content = manifest.read_bytes()
    manifest.unlink()  # a link to the file of another archive
    manifest.write_bytes(content)
    rewrite(manifest, **facts)


def forge_receipt(run: Path, lead: str) -> None:
    """Make a run's receipt lead out of the archive, with hashes that fit."""
    receipt = json.loads((run / "receipt.json").read_text())
    for name in PRODUCTS:
        place = receipt["products"][name]
        receipt["products"][name] = lead + (place.rpartition("/")[2] if place.endswith(".zarr") else "")
    text = json.dumps(receipt).encode()
    files = json.loads((run / "manifest.json").read_text())["files"]
    (run / "receipt.json").unlink()
    (run / "receipt.json").write_bytes(text)
    forge(run, files=files | {"receipt.json": [len(text), digest(text)]})


@pytest.mark.parametrize("lead", LEADS)
def test_a_receipt_that_leads_out_is_not_followed(whole: Whole, outside: Path, tmp_path: Path, lead: str) -> None:
    """Package, export and surveys that read the run refuse its products; no other command follows them."""
    out = whole.copy(tmp_path / "archive")
    forge_receipt(out / whole.run, lead.format(outside=outside))
    run = spectralzoom.open(out).latest
    for read in ("class_map", "mosaic", "lines", "sweeps", "attention", "ground_map", "confidence"):
        with pytest.raises(spectralzoom.Error):
            getattr(run, read)
    tries = Tries()
    commands = {
        **readers(whole, out, tmp_path / "exported"),
        "survey prior": [*asked(out), "--seed", "1", "--prior", whole.run],
        "survey sweeps": [*recorded(whole), "--sweeps", f"{out}/{whole.run}", "--out", str(tmp_path / "again")],
        "gc": ["gc", str(out), "--keep-days", "0"],
        "gc --damaged": ["gc", str(out), "--damaged"],
    }
    for name, command in commands.items():
        ended = ended_in_time(whole.nursery.start(command))
        tries.told(f"{name} with {lead}", ended, codes=(2, *CODES.get(name.split()[0], (0, 1))))
        assert SECRET not in ended.text
        assert ended.code in (1, 2) or name not in ("export", "survey prior", "survey sweeps"), (name, ended.text)
    assert tries.wrong == []


def recorded(whole: Whole) -> list[str]:
    """Return the words of a survey of recorded sweeps."""
    weights = whole.nursery.folder / "weights.safetensors"
    return ["survey", "--engine", "plain", "--weights", str(weights)]


@pytest.mark.parametrize("facts", ["files", "inputs", "rests_on", "stage"])
def test_a_manifest_that_leads_out_is_refused(whole: Whole, outside: Path, tmp_path: Path, facts: str) -> None:
    """Each command ends with output or one message."""
    out = whole.copy(tmp_path / "archive")
    store = next(uri for uri in whole.stores if "/segment/" in uri)
    place = out / (whole.run if facts == "rests_on" else store)
    lead = "../../../outside/secret"
    listed = json.loads((place / "manifest.json").read_text())["files"]
    entry = [len(SECRET), digest(SECRET.encode())]
    changes = {"files": listed | {lead: entry}, "inputs": [lead, "../outside"], "rests_on": {lead: "0"}, "stage": lead}
    forge(place, **{facts: changes[facts]})
    tries = Tries()
    commands = {
        **readers(whole, out, tmp_path / "exported"),
        "survey": asked(out),
        "gc": ["gc", str(out), "--keep-days", "0"],
        "gc --damaged": ["gc", str(out), "--damaged"],
    }
    for name, command in commands.items():
        ended = ended_in_time(whole.nursery.start(command))
        tries.told(f"{name} with {facts}", ended, codes=(2, *CODES.get(name.split()[0], (0, 1))))
        assert SECRET not in ended.text
    assert tries.wrong == []


@pytest.mark.parametrize("spoken", SPOKEN)
def test_a_name_that_leads_out_is_refused(whole: Whole, outside: Path, tmp_path: Path, spoken: str) -> None:
    """Explain, export, the package and the prior map find no run and no store of that name."""
    out = whole.copy(tmp_path / "archive")
    with pytest.raises(spectralzoom.Error):
        spectralzoom.open(out)[spoken]
    tries = Tries()
    commands = {
        "explain": ["explain", str(out), spoken],
        "export": ["export", str(out), spoken, "--out", str(tmp_path / "exported")],
        "survey prior": [*asked(out), "--seed", "1", "--prior", spoken],
        "survey sweeps": [*recorded(whole), "--sweeps", f"{out}/runs/{spoken}", "--out", str(tmp_path / "again")],
    }
    for name, command in commands.items():
        ended = ended_in_time(whole.nursery.start(command))
        tries.told(f"{name} {spoken}", ended, codes=(1, 2))
    assert tries.wrong == []
