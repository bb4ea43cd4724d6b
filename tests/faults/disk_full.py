"""Let the disk run full under a survey: ``python tests/faults/disk_full.py``.

The archive lies on a small tmpfs. Either it is made so small that the survey does not fit, or it is filled up at a
chosen place; then it grows, and the same command runs again. Where no tmpfs can be mounted, not even in a namespace of
its own, the calls are refused from the inside instead, and the table says so.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.faults.fault_table import Clock, Row
from tests.faults.injection import errors_by_name, label
from tests.faults.nursery import ROOT, Ended, Nursery
from tests.faults.small_survey import Subject, prepare, words, wrong_after_fault, wrong_after_rerun

SIZES, EACH = 30, 2
LARGE = 64 << 20  # bytes: more than a survey takes
PAGE = 4096
IN_NAMESPACE = "SPECTRALZOOM_FAULTS_IN_NAMESPACE"
QUICK = ("spool", "segment manifest", "run")  # kinds for the quick part
FULL = ("disk is full", "No space left")
WHERE = {"spool": "spool.", "manifest": "manifests.write_manifest", "run": "run_folder.publish_run"}  # in our functions


@dataclass
class Fills:
    """What came of full disks."""

    met_at: Counter[str] = field(default_factory=Counter)  # what was being written
    told: int = 0
    fitted: int = 0
    wrong: list[str] = field(default_factory=list)

    def words(self) -> str:
        """The figures."""
        places = ", ".join(f"{name} {count}" for name, count in sorted(self.met_at.items()))
        return (
            f"{self.told} failed with one message, {self.fitted} fitted; {len(self.wrong)} wrong"
            f"{': ' + '; '.join(self.wrong[:3]) if self.wrong else ''} (full at: {places})"
        )


def can_mount() -> bool:
    """Whether this process may mount a tmpfs."""
    with tempfile.TemporaryDirectory() as name:
        done = subprocess.run(["mount", "-t", "tmpfs", "none", name], capture_output=True, check=False).returncode == 0
        if done:
            subprocess.run(["umount", name], check=True)
        return done


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """A tmpfs of ``size`` bytes while the block runs."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)
        folder.rmdir()


def grow(folder: Path) -> None:
    """Give a tmpfs room for everything."""
    subprocess.run(["mount", "-o", f"remount,size={LARGE}", str(folder)], check=True)


def openings_by_label(subject: Subject) -> dict[str, int]:
    """How many files are opened to be written, by what they belong to."""
    labels = (label(path) for _, call, path in subject.changing_calls if call == "open")
    return dict(Counter(name for name in labels if name is not None))


def fill_at_places(subject: Subject, each: int, *, mounted: bool, some: tuple[str, ...] = (), seed: int = 0) -> Fills:
    """Fill the disk ``each`` times while each kind (or some) is written, and run again on a larger one."""
    found, chance = Fills(), random.Random(seed)
    for name, count in openings_by_label(subject).items():
        if some and name not in some:
            continue
        for at in sorted(chance.sample(range(1, count + 1), min(each, count))):
            disk = subject.folder / f"disk-{name}-{at}".replace(" ", "-")
            if mounted:
                with small_disk(disk, LARGE // 8):
                    ended = subject.nursery.run(words(disk / "a"), "fill_disk", root=str(disk / "a"), at=at, kind=name)
                    _judge(subject, disk / "a", ended, name, found)
            else:
                number = errors_by_name()["ENOSPC"]
                ended = subject.nursery.run(
                    words(disk / "a"), "refuse", root=str(disk / "a"), at=at, number=number, lasting=True, kind=name
                )
                _judge(subject, disk / "a", ended, name, found)
                shutil.rmtree(disk)
    return found


def try_sizes(subject: Subject, count: int, found: Fills) -> None:
    """Survey on disks from nearly nothing to what the survey takes, and run again on a larger one."""
    taken = _taken(subject)
    for part in range(count):
        pages = max(1, round(taken * (part + 0.5) / count / PAGE))
        with small_disk(subject.folder / f"disk-of-{pages}", pages * PAGE) as disk:
            ended = subject.nursery.run(words(disk / "a"))
            _judge(subject, disk / "a", ended, None, found)


def _taken(subject: Subject) -> int:
    with small_disk(subject.folder / "large", LARGE) as disk:
        assert subject.nursery.run(words(disk / "a")).code == 0
        state = os.statvfs(disk)
        return (state.f_blocks - state.f_bfree) * state.f_frsize


def _judge(subject: Subject, out: Path, ended: Ended, name: str | None, found: Fills) -> None:
    """Look at the archive after the survey failed, let the disk grow, and look again after the rerun."""
    wrong = wrong_after_fault(subject, out)
    if ended.code == 0 and name is None:
        found.fitted += 1
    elif not (ended.told and any(word in ended.message for word in FULL)):
        wrong.append(f"exit {ended.code}, {ended.message[-200:]}")
    else:
        found.told += 1
    found.met_at[name or _met_at(ended)] += 1
    wrong += [
        f"met at {ended.place}" for word, where in WHERE.items() if word in (name or "") and where not in ended.place
    ]
    if os.path.ismount(out.parent):
        grow(out.parent)
    wrong += wrong_after_rerun(subject, out, subject.nursery.run(words(out)))
    found.wrong += [f"{name or out.parent.name}: {one}" for one in wrong]


def _met_at(ended: Ended) -> str:
    """What was being written, by the stage that failed and our functions that the error came through."""
    if ended.code == 0:
        return "nothing"
    failed = [line.split(":")[0] for line in ended.text.splitlines() if line.endswith("failed")]
    words = next((word for word, where in WHERE.items() if where in ended.place), "store")
    return f"{failed[0]} {words}" if failed and words != "run" else words if words == "run" else "archive's folder"


def rows(quick: bool = False) -> list[Row]:
    if can_mount():
        return _rows(quick, "a tmpfs")
    if _can_unshare():
        command = ["unshare", "-rm", sys.executable, str(Path(__file__)), "--rows", *(["--quick"] if quick else [])]
        said = subprocess.run(
            command, cwd=ROOT, env={**os.environ, IN_NAMESPACE: "1"}, capture_output=True, text=True, check=True
        )
        return [Row(**row) for row in json.loads(said.stdout)]
    return _rows(quick, "")


def _can_unshare() -> bool:
    if IN_NAMESPACE in os.environ or shutil.which("unshare") is None:
        return False
    return subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False).returncode == 0


def _rows(quick: bool, kind: str) -> list[Row]:
    where = f"{kind}{' in a namespace of its own' if IN_NAMESPACE in os.environ else ''}"
    clock = Clock()
    with tempfile.TemporaryDirectory(prefix="full-") as name, Nursery(Path(name)) as nursery:
        subject = prepare(nursery)
        found = fill_at_places(subject, 1 if quick else EACH, mounted=bool(kind), some=QUICK if quick else ())
        if kind:
            try_sizes(subject, 1 if quick else SIZES, found)
    injected = f"{where} too small, or filled up while each kind of file is written; then it grows"
    if not kind:
        injected = "ENOSPC refused from the inside (no tmpfs can be mounted here), from each kind of file on"
    row = Row(
        "disk full",
        injected,
        found.told + found.fitted,
        "one message and exit 1, archive verifies, nothing published is lost, rerun bit-identical",
        found.words(),
        not found.wrong and (quick or _everywhere(found)),
        clock.seconds,
    )
    return [row]


def _everywhere(found: Fills) -> bool:
    stages = ("capture", "locate", "rectify", "attend", "patches", "segment")
    wanted = {"spool", "run", "run manifest", *stages, *(f"{stage} manifest" for stage in stages)}
    return wanted <= set(found.met_at)


def main(arguments: list[str]) -> int:
    results = rows("--quick" in arguments)
    if "--rows" in arguments:
        plain: list[dict[str, Any]] = [asdict(row) for row in results]
        print(json.dumps(plain))
    else:
        print("\n".join(f"{row.injected}: {row.found}" for row in results))
    return 0 if all(row.met for row in results) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
