"""The survey for the fault tests: it takes half a second and has every stage that stores data."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from spectralzoom.models.weights.files import save_weights
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, read_manifest
from tests.conftest import RGB_NM, patchy_scene, random_weights
from tests.faults.injection import logged_calls
from tests.faults.nursery import Ended, Nursery

SETTINGS = "[camera]\nsamples = 128\n"  # most time of a small survey goes into samples outside of the field
SURVEY = (
    "survey camera.toml --source sim --scene scene.png --labels labels.png --weights weights.safetensors "
    "--engine plain --budget 0.95 --effects shot --keep raw"
)
UNDISTURBED = "undisturbed"
Stored = dict[str, dict[str, str]]  # address of a store -> SHA-256 of each of its files


@dataclass(frozen=True)
class Subject:
    """A survey to disturb, the nursery that runs it, and the stores of an undisturbed run.

    ``changing_calls`` are all calls that change its archive: number, name, and path below the archive.
    """

    nursery: Nursery
    truth: Stored
    whole_s: float
    changing_calls: list[tuple[int, str, Path]]

    @property
    def folder(self) -> Path:
        """Return the folder of archives and scratch files."""
        return self.nursery.folder

    def surveyed(self, out: Path) -> None:
        """Copy the archive of the undisturbed survey."""
        shutil.copytree(self.folder / UNDISTURBED, out)


def words(out: Path, *more: str) -> list[str]:
    """Return the survey's command into an archive; later flags take precedence."""
    return [*SURVEY.split(), "--out", str(out), *more]


def prepare(nursery: Nursery) -> Subject:
    """Write scene, labels and weights into the nursery's folder, and run the survey undisturbed."""
    folder = nursery.folder
    values, labels = patchy_scene((48, 64), 3, seed=1)
    Image.fromarray(values.astype(np.uint8)).save(folder / "scene.png")
    Image.fromarray(labels).save(folder / "labels.png")
    save_weights(random_weights(RGB_NM), folder / "weights.safetensors")
    (folder / "camera.toml").write_text(SETTINGS)
    counted, out, log = folder / "counted", folder / UNDISTURBED, folder / "counted.calls"
    first = nursery.run(words(counted), "refuse", root=str(counted), at=0, number=0, log=str(log))
    ended = nursery.run(words(out))  # only the first run computes the choice of effects
    for one in (first, ended):
        assert one.code == 0, f"the undisturbed survey failed: {one.text}"
    calls = [(number, name, Path(path).relative_to(counted)) for number, name, path in logged_calls(log)]
    shutil.rmtree(counted)
    log.unlink()
    return Subject(nursery, stored(out), ended.seconds, calls)


def stored(archive: Path) -> Stored:
    """Return the hashes of all files of every published store, by address; empty if there is no archive yet."""
    if not (archive / "stages").is_dir():
        return {}
    opened = Archive.open(archive, create=False, write=False)
    return {
        ref.uri: {name: digest for name, (_, digest) in read_manifest(ref.path)["files"].items()}
        for ref in opened.refs()
    }


def problems(archive: Path) -> list[str]:
    """Return the problems that `verify` finds; empty if there is no archive yet."""
    if not (archive / "stages").is_dir():
        return []
    opened = Archive.open(archive, create=False, write=False)
    return [f"{finding.uri} {finding.problem}" for finding in verify_everything(opened) if finding.problem is not None]


def wrong_after_fault(subject: Subject, archive: Path, before: Stored | None = None) -> list[str]:
    """Return the errors in an archive after a fault: damage, lost stores and changed stores."""
    now = stored(archive)
    return [
        *problems(archive),
        *(f"{uri} was lost" for uri in set(before or {}) - set(now)),
        *(f"{uri} is other than undisturbed" for uri, files in now.items() if subject.truth.get(uri) != files),
    ]


def wrong_after_rerun(subject: Subject, archive: Path, ended: Ended, *, runs: int | None = None) -> list[str]:
    """Return the errors in an archive after a rerun: every store must be complete, without leftovers."""
    if ended.code != 0:
        return [f"the rerun failed: {ended.message}"]
    left = [path.relative_to(archive).as_posix() for path in archive.rglob("*.part")]
    found = [*wrong_after_fault(subject, archive, subject.truth), *(f"{name} was left" for name in left)]
    if any((archive / "spool").glob("*")):
        found.append("a spool was left")
    there = len(Archive.open(archive, create=False, write=False).runs())
    return found + ([f"{there} runs are listed, expected {runs}"] if runs not in (None, there) else [])
