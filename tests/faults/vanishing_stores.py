"""Remove stores while other commands read the archive: ``python tests/faults vanishing_stores``.

`gc` of another process may remove a store at any moment. So commands are started beside it; and each command is tried
alone, while all stores that no run names vanish just before one of its system calls.
"""

from __future__ import annotations

import random
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from spectralzoom.storage.store import Archive
from tests.faults.fault_table import Row, reported_wrong
from tests.faults.nursery import Ended, Nursery
from tests.faults.small_survey import UNDISTURBED, Subject, prepare, problems, words
from tests.storage.small_archive import small_survey

STORES = 60
VERBS = ("survey", "gc", "verify", "ls", "explain")
CODES = {"verify": (0,), "gc": (0, 1, 3)}  # of others 0 and 1; a store that goes is no damage


@dataclass
class Vanished:
    """Count commands, and stores that went meanwhile."""

    codes: Counter[tuple[str, int]] = field(default_factory=Counter)  # ends by verb and exit code
    removed: int = 0
    wrong: list[str] = field(default_factory=list)

    @property
    def tried(self) -> int:
        """Return the number of commands."""
        return sum(self.codes.values())

    def told(self, verb: str, called: str, ended: Ended) -> None:
        """Note what is wrong with the end of a command."""
        self.codes[verb, ended.code] += 1
        errors = [line for line in ended.text.splitlines() if line.startswith("error: ")]
        if "Traceback" in ended.text or "defect" in ended.text or ended.code not in CODES.get(verb, (0, 1)):
            self.wrong.append(f"{verb} {called}: exit {ended.code}: {ended.text[-400:]}")
        elif len(errors) != (ended.code == 1):
            self.wrong.append(f"{verb} {called}: exit {ended.code} with {len(errors)} messages: {ended.text[-400:]}")


def crowded(subject: Subject, out: Path) -> Path:
    """Copy the archive of the undisturbed survey, and add 60 stores that no run names."""
    subject.surveyed(out)
    archive = Archive.open(out)
    for seed in range(STORES // 3):
        small_survey(archive, seed=seed, named=False)
    return out


def command(verb: str, out: Path) -> list[str]:
    """Return the words of a command on an archive."""
    more = {"gc": ["--keep-days", "0"], "explain": ["class_map"]}
    return words(out) if verb == "survey" else [verb, str(out), *more.get(verb, ())]


def start_beside_gc(subject: Subject, folder: Path, rounds: int, each: int) -> Vanished:
    """Start every verb some times while `gc` of another process removes the stores, in several archives."""
    found = Vanished()
    rng = random.Random(0)
    for number in range(rounds):
        out = crowded(subject, folder / f"crowded-{number}")
        before = _count(out)
        verbs = [verb for verb in VERBS for _ in range(each)]
        rng.shuffle(verbs)
        children = [(verb, subject.nursery.start(command(verb, out))) for verb in verbs[: len(verbs) // 2]]
        remover = subject.nursery.start(command("gc", out))
        children += [(verb, subject.nursery.start(command(verb, out))) for verb in verbs[len(verbs) // 2 :]]
        for verb, child in (("gc", remover), *children):
            found.told(verb, "beside gc", child.wait())
        for _ in range(2):  # the surveys have ended; a gc that began before may have left stores to this one
            found.told("gc", "at the end", subject.nursery.run(command("gc", out)))
        found.removed += before - _count(out)
        found.wrong += problems(out)
    return found


def vanish_at_calls(subject: Subject, folder: Path, count: int, seed: int) -> Vanished:
    """Let all stores that no run names vanish before a random call of each verb; nothing else may be lost."""
    found = Vanished()
    rng = random.Random(seed)
    for number in range(count):
        verb = VERBS[number % len(VERBS)]
        out = crowded(subject, folder / f"vanishing-{number}")
        before = _count(out)
        at = int(10 ** rng.uniform(0, 3))
        arguments: dict[str, Any] = {"root": str(out), "at": at, "kept": kept_stores(subject)}
        found.told(verb, f"before call {at}", subject.nursery.run(command(verb, out), "vanish_before", **arguments))
        found.removed += before - _count(out)
        found.wrong += problems(out)
    return found


def kept_stores(subject: Subject) -> list[str]:
    """Return the addresses of the stores of the undisturbed survey, and of the manifests of cleared ones."""
    archive = subject.folder / UNDISTURBED
    cleared = (path.relative_to(archive).as_posix() for path in archive.glob("stages/*/*.cleared"))
    return sorted({*subject.truth, *cleared})


def _count(out: Path) -> int:
    return len([*out.glob("stages/*/*/manifest.json"), *out.glob("stages/*/*.cleared")])


def rows(quick: bool) -> Iterator[Row]:
    """Yield a row for commands beside `gc`, and one for stores that vanish before a call."""
    with tempfile.TemporaryDirectory(prefix="vanishing-") as name, Nursery(Path(name)) as nursery:
        subject = prepare(nursery)
        cases: Sequence[tuple[str, Vanished]] = (
            ("gc of another process", start_beside_gc(subject, Path(name), 1 if quick else 5, 3)),
            ("before any one call", vanish_at_calls(subject, Path(name), 10 if quick else 200, 0)),
        )
        for injected, found in cases:
            told = f"{found.removed} stores went; {dict(found.codes)}; {reported_wrong(found.wrong)}"
            yield Row("stores vanish", injected, found.tried, "exit 0 or one message, no damage", told, not found.wrong)
