"""A field's visits, for a page of its history: when each looked, its map in pictures, what changed, and its words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.publish.change_picture import CHANGED_SHARE
from flows.publish.page_parts import in_base64, indexed_png
from flows.publish.panels import UNLABELLED_COLOUR, class_palette
from flows.publish.receipt_words import days_words
from flows.schedule.field_schedule import read_moment
from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.terminal.figures import format_percent, format_points, format_seconds, known_number
from pipeline.simulator.scenes.farm.farm_scene import USUAL_HOUR
from storage.archive.archive import Archive
from storage.archive.records import Run
from storage.arrays.beliefs import BeliefStore
from storage.arrays.class_maps import ClassMap, load_class_map

MOST_VISITS = 60  # that a page plays: the newest
MOST_PX = 400  # of a picture's longer side
PALE = 0.8  # of what did not change
MOST_CLASSES = 128  # that are told apart, the last of them standing for none


def look_of(run: Run, due: object) -> datetime | None:
    """The moment that a run's visit is called by, else when it was ``due``, else the day that its farm was drawn on.

    Of others when they began, or were published. The day is of the year in which the run was published. None where
    nothing of that can be read.
    """
    named = next((at for at in map(read_moment, (run.settings.get("visit"), due)) if at is not None), None)
    if named is not None:
        return named
    began = next((at for at in map(read_moment, (run.receipt.get("started"), run.created)) if at is not None), None)
    return _day_of_farm(run.settings, began) or began


def _day_of_farm(settings: Mapping[str, Any], published: datetime | None) -> datetime | None:
    day, hour = settings.get("day"), settings.get("hour")
    if settings.get("scene") not in BUILT_IN_SCENES or not isinstance(day, int) or published is None:
        return None
    of_day = float(hour) if isinstance(hour, int | float) else USUAL_HOUR
    if not (1 <= day <= 366 and 0 <= of_day <= 24):
        return None
    return datetime(published.year, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=of_day)


@dataclass(frozen=True)
class VisitPicture:
    """One visit: when, its map and what changed of it as PNG in base64, and what is said of it."""

    when: str
    map: str
    changes: str  # all else pale; empty of a first look
    words: str


def visit_pictures(archive: Archive, runs: Sequence[tuple[Run, str]]) -> list[VisitPicture]:
    """Pictures of runs with a map, given with words for when they looked, oldest first; damaged ones are left out."""
    found = []
    for run, when in runs[-MOST_VISITS:]:
        address = run.products.get("class_map")
        if run.problem is None and address is not None:
            with suppress(OSError, LookupError, ValueError):
                shown = load_class_map(archive.locate(address))
                changed = _changed_pixels(archive, run, shown.classes.shape)
                found.append(VisitPicture(when, *_drawn(shown, changed), _words(run.receipt)))
    return found


def _changed_pixels(archive: Archive, run: Run, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Pixels (y, x) of seats with another class than remembered; None of a first look."""
    address = run.products.get("belief")
    store = None if address is None else BeliefStore(archive.locate(address))
    changed = None if store is None else store.changed()
    if store is None or changed is None:
        return None
    seats = changed >= CHANGED_SHARE
    return seats.repeat(store.patch_px, axis=0).repeat(store.patch_px, axis=1)[: shape[0], : shape[1]]


def _drawn(shown: ClassMap, changed: NDArray[np.bool_] | None) -> tuple[str, str]:
    """The map, and what changed of it among pale colours."""
    thin = -(-max(shown.classes.shape) // MOST_PX)
    palette = np.tile(np.asarray(UNLABELLED_COLOUR, np.float32), (MOST_CLASSES, 1))
    known = class_palette(len(shown.names), shown.colours)[: MOST_CLASSES - 1]
    palette[: len(known)] = known
    table = np.rint(255 * np.concatenate([palette, PALE + (1 - PALE) * palette])).astype(np.uint8)
    numbers = np.minimum(shown.classes[::thin, ::thin], MOST_CLASSES - 1)
    drawn = in_base64(indexed_png(numbers, table))
    if changed is None:
        return drawn, ""
    pale = np.where(changed[::thin, ::thin], 0, MOST_CLASSES).astype(np.uint8)
    return drawn, in_base64(indexed_png(numbers + pale, table))


def _words(receipt: Mapping[str, Any]) -> str:
    """Seconds spent, score, and what became of the memory."""
    savings = receipt.get("savings") or {}
    seconds = known_number((savings.get("capture_s") or {}).get("done"))
    parts = [] if seconds is None else [f"{format_seconds(seconds)} at the camera"]
    score = known_number((receipt.get("accuracy") or {}).get("miou"))
    parts += [] if score is None else [f"mIoU {format_points(score)}"]
    memory = receipt.get("memory")
    if not isinstance(memory, Mapping):
        return ", ".join([*parts, "a first look"])
    if memory.get("put_aside"):
        return ", ".join([*parts, f"its memory put aside ({memory['put_aside']})"])
    share = memory["changed_px"] / memory["compared_px"] if memory.get("compared_px") else 0.0
    return ", ".join([*parts, f"goes on from {days_words(memory['days'])}", f"{format_percent(share)} changed"])
