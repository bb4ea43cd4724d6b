"""Flip one bit in the metadata of an archive: ``python tests/faults metadata_flips``.

A file without a checksum of its own is every one that is no chunk of an array: zarr.json, tables, statistics, manifests
and receipts. After each flip a survey (of the same settings; every third time without the stores that were made of the
damaged one), the package and the export must end in an error that names the store and the command that removes it, or
give the numbers of before. After that command the same survey makes the same bytes.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import spectralzoom
from tests.faults.fault_table import Row, reported_wrong
from tests.faults.nursery import Ended, Nursery
from tests.faults.small_survey import prepare
from tests.faults.whole_survey import Whole, descendants, maps_of, numbers_of, other_receipt, stored_files, survey_whole

AIMS = {  # name of a field of zarr.json or of a table, and what of its value is changed
    "shape": rb'"shape": \[\s*(\d)',
    "dtype": rb'"data_type": "[a-z]+(\d)',
    "chunk shape": rb'"chunk_shape": \[\s*(\d)',
    "fill value": rb'"fill_value": "?(\w)',
    "codec": rb'"codecs": \[\s*\{\s*"name": "(\w)',
    "endian": rb'"endian": "(\w)',
    "element size": rb'"typesize": (\d)',
    "scale": rb'"scale_factor": (\d)',
    "offset": rb'"add_offset": -?(\d)',
    "dimension name": rb'"dimension_names": \[\s*"(\w)',
    "attribute name": rb'"attributes": \{\s*"(\w)',
    "attribute": rb'"attributes": \{\s*"\w+": ["\[]*(\w)',
    "format": rb'"zarr_format": (\d)',
    "number": rb": -?(\d)",
    "text": rb': "(\w)',
    "last digit": rb".*\d\.\d*(\d)",
}
CURE = "gc --damaged"


@dataclass(frozen=True)
class Flip:
    """One bit of a file."""

    uri: str  # of its store or run
    name: str  # of the file in it
    at: int
    bit: int
    aim: str = "drawn"

    def __str__(self) -> str:
        return f"{self.uri}/{self.name}, byte {self.at}, bit {self.bit} ({self.aim})"

    def apply(self, out: Path) -> None:
        """Replace the file by one with the other bit."""
        path = out / self.uri / self.name
        content = bytearray(path.read_bytes())
        content[self.at] ^= 1 << self.bit
        path.unlink()
        path.write_bytes(content)

    def undo(self, whole: Whole, out: Path) -> None:
        """Put the file of the undisturbed archive back."""
        (out / self.uri / self.name).unlink()
        os.link(whole.out / self.uri / self.name, out / self.uri / self.name)


@dataclass
class Flips:
    """Count what readers and surveys made of flips."""

    tried: Counter[str] = field(default_factory=Counter)  # flips by aim
    refused: Counter[str] = field(default_factory=Counter)  # by reader
    same: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


def metadata_of(whole: Whole) -> list[tuple[str, str]]:
    """Return store and name of each file without a checksum of its own; pictures and the page have no numbers."""
    found = []
    for uri in (*whole.stores, whole.run):
        for path in sorted((whole.out / uri).rglob("*")):
            name = path.relative_to(whole.out / uri).as_posix()
            chunk = re.search(r"\.zarr/(.*/)?c([./]|$)", name) is not None
            if path.is_file() and not chunk and path.suffix not in (".png", ".html", ""):
                found.append((uri, name))
    return found


def drawn_flips(whole: Whole, count: int, seed: int) -> list[Flip]:
    """Return flips of random bits of random files, each store as often as any other."""
    rng, files = Random(seed), metadata_of(whole)
    uris = list(dict.fromkeys(uri for uri, _ in files))
    flips = []
    for number in range(count):
        uri = uris[number % len(uris)]
        name = rng.choice([name for one, name in files if one == uri])
        flips.append(Flip(uri, name, rng.randrange((whole.out / uri / name).stat().st_size), rng.randrange(8)))
    return flips


def aimed_flips(whole: Whole) -> list[Flip]:
    """Return a flip of each field that a file has, so that a digit stays a digit and a letter a letter."""
    flips = []
    for uri, name in metadata_of(whole):
        content = (whole.out / uri / name).read_bytes()
        for aim, pattern in AIMS.items():
            for found in list(re.finditer(pattern, content))[:2]:
                flips.append(Flip(uri, name, found.start(1), 0, aim))
    return flips


def each_kind(flips: Iterable[Flip], most: int) -> list[Flip]:
    """Return flips of different aims for each store, at most so many, in turn."""
    by_store: dict[str, dict[str, Flip]] = {}
    for flip in flips:
        by_store.setdefault(flip.uri, {}).setdefault(flip.aim, flip)
    chosen = []
    for number, aims in enumerate(by_store.values()):
        order = sorted(aims.values(), key=lambda flip: list(AIMS).index(flip.aim))
        turned = order[number % len(order) :] + order[: number % len(order)]
        chosen += turned[:most]
    return chosen


def try_flip(whole: Whole, flip: Flip, out: Path, found: Flips, *, alone: bool, exported: bool, cured: bool) -> None:
    """Flip a bit in a copy of the archive, read and survey it, and with ``cured`` remove the damage and survey again.

    ``alone`` removes before the survey all stores that were made of the damaged one, so that it is read for them. The
    copy is left if nothing but the flip has changed it, which is undone.
    """
    if not out.exists():
        whole.copy(out)
    flip.apply(out)
    found.tried[flip.aim] += 1
    wrong = [*_read(whole, flip, out, found), *(_exported(whole, flip, out, found) if exported else ())]
    for path in descendants(whole.out, flip.uri) if alone and not flip.uri.startswith("runs/") else ():
        shutil.rmtree(out / path.relative_to(whole.out))
    published = found.same["survey"]
    wrong += _surveyed(whole, flip, out, found)
    if cured:
        removed = whole.nursery.run(["gc", str(out), "--damaged"])
        again = whole.survey(out)
        wrong += [f"{one.code}: {one.text}" for one in (removed, again) if one.code != 0]
        now = stored_files(out)
        wrong += [
            f"after it {name} differs" for name in {**now, **whole.files} if now.get(name) != whole.files.get(name)
        ]
        wrong += [f"after it {name} of the receipt differs" for name in other_receipt(whole, out)] if not wrong else []
    if cured or alone or found.same["survey"] != published or not (out / flip.uri / flip.name).exists():
        shutil.rmtree(out)
    else:
        flip.undo(whole, out)
    found.wrong += [f"{flip}: {one}" for one in wrong[:3]]


def _read(whole: Whole, flip: Flip, out: Path, found: Flips) -> Iterator[str]:
    try:
        now = numbers_of(out, flip.uri, whole.run.removeprefix("runs/"))
    except spectralzoom.Error as error:
        found.refused["package"] += 1
        if flip.uri not in str(error) or CURE not in str(error):
            yield f"the package says {error}"
    except Exception as error:  # any other exception is the defect that this test searches for
        yield f"the package raises {type(error).__name__}: {error}"
    else:
        found.same["package"] += 1
        if now != whole.numbers[flip.uri]:
            yield "the package gives other numbers"


def _exported(whole: Whole, flip: Flip, out: Path, found: Flips) -> Iterator[str]:
    to = out.with_name("exported")
    shutil.rmtree(to, ignore_errors=True)
    ended = whole.nursery.run(["export", str(out), whole.run, "--out", str(to)])
    yield from _told(flip, ended, "export", found)
    if ended.code == 0 and maps_of(to) != whole.exported:
        yield "export writes other numbers"


def _surveyed(whole: Whole, flip: Flip, out: Path, found: Flips) -> Iterator[str]:
    ended = whole.survey(out)
    yield from _told(flip, ended, "survey", found)
    if ended.code == 0:
        yield from (f"survey made another {name}" for name in _others(whole, flip, out))
        yield from (f"survey published another {name}" for name in other_receipt(whole, out))


def _others(whole: Whole, flip: Flip, out: Path) -> list[str]:
    """Return the files of all stores but the damaged file that differ."""
    now = stored_files(out)
    return [name for name in now if now[name] != whole.files.get(name) and name != f"{flip.uri}/{flip.name}"]


def _told(flip: Flip, ended: Ended, verb: str, found: Flips) -> Iterator[str]:
    if ended.code == 0:
        found.same[verb] += 1
        return
    found.refused[verb] += 1
    errors = [line for line in ended.text.splitlines() if line.startswith("error: ")]
    one = len(errors) == 1 and flip.uri in errors[0] and CURE in errors[0]
    if not one or ended.code != 1 or "Traceback" in ended.text or "defect" in ended.text:
        yield f"{verb} ends with {ended.code}: {ended.text[-300:]}"


def try_flips(whole: Whole, flips: Sequence[Flip], folder: Path, *, exported: int = 1, cured: int = 1) -> Flips:
    """Try flips in copies of the archive: how many flips come to one export, and to one removal with a survey after it.

    Both are chosen so that each kind of store has its turn.
    """
    found = Flips()
    for number, flip in enumerate(flips):
        parts = {"alone": number % 3 == 1, "exported": number % exported == 0, "cured": number % cured == 0}
        try_flip(whole, flip, folder / "flipped", found, **parts)
    return found


def rows(quick: bool) -> Iterator[Row]:
    """Yield a row for random flips and one for aimed ones."""
    with tempfile.TemporaryDirectory(prefix="flips-") as name, Nursery(Path(name)) as nursery:
        whole = survey_whole(prepare(nursery))
        aimed = each_kind(aimed_flips(whole), 2 if quick else len(AIMS))
        cases = {"drawn": drawn_flips(whole, 26 if quick else 300, 0), "aimed": aimed}
        for kind, flips in cases.items():
            found = try_flips(whole, flips, Path(name))
            demanded = "an error that names the store and its removal, or the same numbers; then the same bytes again"
            words = f"refused: {dict(found.refused)}, same: {dict(found.same)}, {reported_wrong(found.wrong)}"
            injected = f"one bit of a file without a checksum, {kind}, in {len(whole.stores) + 1} stores and runs"
            yield Row("a bit flips in metadata", injected, sum(found.tried.values()), demanded, words, not found.wrong)
