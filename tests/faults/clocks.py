"""Surveys on a machine whose clock is wrong: ``python tests/faults clocks``.

What the process sees of the time of day is changed from the inside; the dates of files are set as that clock would
have set them. Each case gives what was wrong, and is counted by the surveys that it took.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from storage.archive.archive import Archive
from storage.archive.staging import MANIFEST_NAME
from storage.maintenance.garbage import clear_up
from tests.faults.fault_table import Clock, Row, reported_wrong
from tests.faults.nursery import Nursery
from tests.faults.small_survey import Subject, prepare, words, wrong_after_fault, wrong_after_rerun

DAY_S = 86400.0
FAR = 400 * DAY_S
WRONG: dict[str, dict[str, Any]] = {
    "an hour back": {"shift_s": -3600.0},
    "400 days back": {"shift_s": -FAR},
    "400 days ahead": {"shift_s": FAR},
    "jumping by up to 400 days at each look": {"shift_s": 0.0, "jumps_s": FAR},
    "standing still": {"shift_s": 0.0, "frozen": True},
}

Case = Callable[[Subject, Path, dict[str, Any]], list[str]]


def same_keys(subject: Subject, out: Path, clock: dict[str, Any]) -> list[str]:
    """A survey by a wrong clock, the same again by it and by the right one: the same stores, made once."""
    wrong: list[str] = []
    for number, fault in enumerate(("wrong_clock", "wrong_clock", None)):
        ended = subject.nursery.run(words(out), fault, **(clock if fault else {}))
        if number and "% ran" in ended.text:
            wrong.append("a stage was made again")
        wrong += wrong_after_rerun(subject, out, ended, runs=number + 1)
        _date_files(out)
    return [*wrong, *_order(out)]


def same_moment(subject: Subject, out: Path, clock: dict[str, Any]) -> list[str]:
    """Three surveys by a clock that stands: three runs, none in the place of another."""
    children = [subject.nursery.start(words(out), "wrong_clock", **clock) for _ in range(3)]
    ended = [child.wait() for child in children]
    wrong = [f"exit {one.code}: {one.message}" for one in ended if one.code != 0]
    return [*wrong, *wrong_after_rerun(subject, out, subject.nursery.run(words(out)), runs=4), *_order(out)]


def cleared_up(subject: Subject, out: Path, clock: dict[str, Any]) -> list[str]:
    """gc after a survey that began by the right clock, went on by a wrong one and was killed before its end."""
    subject.surveyed(out)
    wrong: list[str] = []
    shutil.rmtree(out / "runs")  # killed before it named anything
    archive = Archive.open(out)
    later = {ref.uri for stage in ("rectify", "score", "patches", "segment", "evaluate") for ref in archive.refs(stage)}
    for ref in archive.refs():
        if ref.uri in later:
            _redate(ref.path, clock["shift_s"])
    with archive.in_use():
        wrong += [f"{gone.uri} went while in use" for gone in clear_up(archive).removals if gone.what == "store"]
    wrong += [f"{gone.uri} went, made a moment ago" for gone in clear_up(archive).removals if gone.what == "store"]
    ended = subject.nursery.run(words(out))
    wrong += ["gc took what the survey needs"] if "% ran" in ended.text else []
    wrong += wrong_after_rerun(subject, out, ended)
    wrong += [f"{gone.uri} went, and a run names it" for gone in clear_up(archive, keep_days=0).removals]
    return [*wrong, *wrong_after_fault(subject, out, subject.truth)]


CASES: dict[str, tuple[Case, tuple[str, ...], str]] = {
    "clock wrong in surveys": (
        same_keys,
        tuple(WRONG),
        "keys and bytes as ever, nothing made twice, runs in the order of their dates, archive verifies",
    ),
    "clock stands": (same_moment, ("standing still",), "three surveys at once: a run listed for each"),
    "clock set back, then gc": (cleared_up, ("an hour back", "400 days back"), "nothing fresh, in use or named goes"),
}


def _order(out: Path) -> list[str]:
    runs = Archive.open(out, create=False, write=False).runs()
    dates = [folder.name.split("-")[0] for folder in runs]
    return [] if dates == sorted(dates) and len(set(runs)) == len(runs) else [f"runs are listed as {dates}"]


def _date_files(out: Path) -> None:
    """Give each published folder's files the date that its manifest states, as the clock then would have."""
    for manifest in out.glob(f"*/*/**/{MANIFEST_NAME}"):
        moment = datetime.fromisoformat(json.loads(manifest.read_text())["created"]).timestamp()
        for path in (*manifest.parent.rglob("*"), manifest.parent):
            os.utime(path, (moment, moment))


def _redate(folder: Path, shift_s: float) -> None:
    """Shift all dates of a store, also that in its manifest, which is checksummed again."""
    from storage.archive.manifests import write_manifest

    facts = json.loads((folder / MANIFEST_NAME).read_text())
    created = datetime.fromtimestamp(datetime.fromisoformat(facts["created"]).timestamp() + shift_s).astimezone()
    (folder / MANIFEST_NAME).unlink()
    write_manifest(
        folder,
        {name: facts[name] for name in facts if name not in ("files", "format", "seal")}
        | {"created": created.isoformat(timespec="milliseconds")},
    )
    for path in (*folder.rglob("*"), folder):
        os.utime(path, (created.timestamp(), created.timestamp()))


def rows(quick: bool = False) -> list[Row]:
    with tempfile.TemporaryDirectory(prefix="clocks-") as name, Nursery(Path(name)) as nursery:
        subject = prepare(nursery)
        return [_row(subject, fault, quick) for fault in CASES]


def _row(subject: Subject, fault: str, quick: bool) -> Row:
    case, clocks, demanded = CASES[fault]
    chosen = clocks[1:2] or clocks if quick else clocks
    timer, wrong = Clock(), list[str]()
    for number, name in enumerate(chosen):
        out = subject.folder / f"{fault.replace(' ', '-').replace(',', '')}-{number}"
        wrong += [f"{name}: {one}" for one in case(subject, out, WRONG[name])]
        shutil.rmtree(out)
    injected = f"the time that the process sees: {', '.join(chosen)}"
    return Row(fault, injected, len(chosen), demanded, reported_wrong(wrong), not wrong, timer.seconds)
