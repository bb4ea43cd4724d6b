"""What visits to a farm leave on the disk: surveys into one archive, and all bytes below it by stage.

Quick looks go on from each other; full scans remember nothing. Both keep their beliefs, reports and pictures, and
lose their fine patches to `gc --patches-too`, as raw lines give them again.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from measure import Row
from rich.console import Console

from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from flows.tasks.open_survey import versions_made_again
from flows.terminal.figures import format_bytes, format_percent
from storage.archive.archive import Archive
from storage.maintenance.garbage import clear_up
from storage.maintenance.verification import verify_everything

GOAL = 0.25  # of what full scans store
Moment = tuple[int, float]  # day and hour
How = tuple[int, float]  # pixels from line to line, and their exposure [ms]


def stored_rows(size_px: tuple[int, int], moments: Sequence[Moment], quick: How, full: How) -> Iterator[Row]:
    """Visits to a farm of (y, x) px at some moments, by quick looks that remember and by full scans."""
    stored: dict[str, Counter[str]] = {}
    cleared: dict[str, int] = {}
    for name, how, prior in (("quick looks that remember", quick, "latest"), ("full scans", full, "none")):
        with tempfile.TemporaryDirectory(prefix="stored-") as folder:
            survey_visits(Path(folder), size_px, moments, how, prior)
            stored[name] = bytes_by_stage(Path(folder))
            clear_up(Archive.open(folder), keep_days=0, made_again=versions_made_again())
            cleared[name] = bytes_by_stage(Path(folder)).total()
            broken = [one.uri for one in verify_everything(Path(folder)) if one.problem is not None]
        what = f"stored by {len(moments)} {name}, lines of {how[1]:g} ms, {how[0]} px apart"
        yield Row(what, f"{format_bytes(stored[name].total())}: {_shares(stored[name])}")
        yield Row("the same after gc --patches-too", format_bytes(cleared[name]))
        yield Row("what verify finds wrong then", str(len(broken)), "0", not broken)
    (looks, scans), (looks_left, scans_left) = stored.values(), cleared.values()
    yield Row("quick looks of full scans, all bytes", format_percent(looks.total() / scans.total()))
    share = looks_left / scans.total()
    yield Row("the same, quick looks after gc --patches-too", format_percent(share), f"<= {GOAL:.0%}", share <= GOAL)
    yield Row("the same, both after gc --patches-too", format_percent(looks_left / scans_left))


def survey_visits(archive: Path, size_px: tuple[int, int], moments: Sequence[Moment], how: How, prior: str) -> None:
    """Survey one farm at each moment into one archive."""
    flags = {"scene": "farm", "seed": 1, "size": f"{size_px[1]}x{size_px[0]}", "name": "north", "out": str(archive)}
    flags |= {"engine": "plain", "accuracy": False, "scan_step": how[0], "scan_exposure_ms": how[1], "prior": prior}
    for day, hour in moments:
        looked = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=hour)
        moment = {"day": day, "hour": hour, "visit": looked.isoformat()}
        run_survey(load_settings(None, flags | moment), Console(quiet=True))


def bytes_by_stage(archive: Path) -> Counter[str]:
    """Bytes of all files below an archive, by the stage that stored them; by the folder where none did."""
    found: Counter[str] = Counter()
    for path in archive.rglob("*"):
        if path.is_file():
            parts = path.relative_to(archive).parts
            found[parts[1] if parts[0] == "stages" else parts[0]] += path.stat().st_size
    return found


def _shares(stored: Mapping[str, int]) -> str:
    whole = sum(stored.values())
    return ", ".join(
        f"{name} {format_percent(size / whole)}"
        for name, size in sorted(stored.items(), key=lambda one: -one[1])
        if size > whole / 1000
    )
