"""What ledgers and an archive add up to: an ending for each due time, and nothing left behind that nobody explains."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from flows.schedule.field_schedule import ENDINGS, moment_words, read_moment
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.maintenance.garbage import clear_up
from storage.remote.opening import verify_archive

GONE = "process was gone"  # in the reason of a run that was killed and not begun again
Line = Mapping[str, Any]
Look = tuple[int, str]  # the seed of a field's scene, and the visit, as the settings have them


@dataclass
class Account:
    """Endings of the due times of one or more fields."""

    due: int = 0
    endings: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)  # not one ending, one without a reason, or of no due time
    resumed: int = 0  # done after more than one attempt
    attempts: dict[tuple[str, str], int] = field(default_factory=dict)  # field and due time -> how often it began
    failed: dict[tuple[str, str], str] = field(default_factory=dict)  # field and due time -> reason

    def add(self, name: str, lines: Iterable[Line], due_times: Iterable[datetime]) -> None:
        """Count the due times of a field."""
        by_due: dict[datetime | None, list[Line]] = {}
        for line in lines:
            if line["event"] in ENDINGS:
                by_due.setdefault(read_moment(line.get("due")), []).append(line)
        for due in due_times:
            self.due += 1
            found = by_due.pop(due, [])
            if len(found) != 1:
                self.wrong.append(f"{name} {due:%H:%M:%S} has {len(found)} endings")
                continue
            (ending,) = found
            self.endings[ending["event"]] += 1
            self.attempts[name, moment_words(due)] = ending.get("attempts", 0)
            self.resumed += ending["event"] == "done" and ending.get("attempts", 1) > 1
            if ending["event"] != "done" and not ending.get("reason"):
                self.wrong.append(f"{name} {due:%H:%M:%S} {ending['event']} without a reason")
            if ending["event"] == "failed":
                self.failed[name, moment_words(due)] = str(ending.get("reason"))
        for lines_of in by_due.values():
            self.wrong += [f"{name} {line.get('due')} {line['event']}, which was never due" for line in lines_of]

    def words(self) -> str:
        """The counts."""
        counts = ", ".join(f"{self.endings[name]} {name}" for name in ENDINGS)
        wrong = f"; WRONG: {'; '.join(self.wrong[:3])} ({len(self.wrong)})" if self.wrong else ""
        return f"{self.due} due: {counts} ({self.resumed} done after being resumed){wrong}"

    def failed_by(self, *words: str) -> int:
        """How many failed with one of these words in the reason."""
        return sum(any(word in reason for word in words) for reason in self.failed.values())

    def begun_again(self, name: str, due: datetime) -> bool:
        """Whether a run began more than once under its due time."""
        return self.attempts.get((name, moment_words(due)), 0) > 1

    def after_kills(self, killed: Sequence[tuple[str, datetime]]) -> tuple[int, int]:
        """Of runs that were killed: how many were begun again, and how many of the others failed because of it."""
        others = [run for run in killed if not self.begun_again(*run)]
        return len(killed) - len(others), sum(self.names(*run, "", [GONE]) for run in others)

    def names(self, name: str, due: datetime, device: str, words: Iterable[str]) -> bool:
        """Whether a run failed by a device: its reason has the device's name, and one of the words."""
        reason = self.failed.get((name, moment_words(due)), "")
        return device in reason and any(word in reason for word in words)


@dataclass
class Leftovers:
    """What gc took away, what stayed, and what of it nobody explains."""

    removed: Counter[str]
    kept: Counter[str]
    unexplained: list[str]

    def words(self) -> str:
        """In one line."""
        parts = [
            ", ".join(f"{count} {what}" for what, count in sorted(one.items()) if count) or "nothing"
            for one in (self.removed, self.kept)
        ]
        found = f"; UNEXPLAINED: {'; '.join(self.unexplained[:3])} ({len(self.unexplained)})"
        return f"removed: {parts[0]}; stays: {parts[1]}{found if self.unexplained else '; nothing unexplained'}"


def clear(archive: Archive, failed: Iterable[Look], spools: Mapping[str, Look]) -> Leftovers:
    """Run gc and look at what is left that no run names.

    Only what belongs to looks that failed may stay: their raw lines, which cannot be had again, and lines under way.
    ``spools`` says in which look each spool appeared.
    """
    looks = set(failed)
    done = clear_up(archive, keep_days=0)
    found = Leftovers(Counter(one.what for one in done.removals), Counter(), [])
    if done.obstacle:
        found.unexplained.append(done.obstacle)
    _look_at_stores(archive, looks, done.kept, found)
    for spool in sorted((archive.root / "spool").glob("*")):
        if spools.get(spool.name) in looks:
            found.kept["lines under way of a failed run"] += 1
        else:
            found.unexplained.append(f"spool/{spool.name} of {spools.get(spool.name)}")
    found.unexplained += [str(path.relative_to(archive.root)) for path in archive.root.glob("*/*/*.part")]
    return found


def problems_of(archive: Archive) -> list[str]:
    """What `verify` finds."""
    return [f"{found.uri}: {found.problem}" for found in verify_archive(archive) if found.problem is not None]


def _look_at_stores(archive: Archive, looks: set[Look], kept: Mapping[str, str], found: Leftovers) -> None:
    catalogue = Catalogue.read(archive.root)
    named = set[str]().union(*(catalogue.named_and_below[run.uri] for run in catalogue.runs))
    rest = set(catalogue.stores) - named
    raw = set[str]()
    for uri in rest & set(kept):
        params = archive.manifest(catalogue.stores[uri].ref)["params"]
        if (params.get("seed"), params.get("visit")) in looks:
            raw.add(uri)
    below = (catalogue.ancestors(raw) & rest) - raw
    found.kept["raw of a failed run"] += len(raw)
    found.kept["what that rests on"] += len(below)
    found.unexplained += [f"{uri}, which no run names" for uri in sorted(rest - raw - below)]
