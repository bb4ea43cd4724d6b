"""Days and moments of acquisition in the fields of files."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from spectralzoom.storage.readers.acquired import acquired_of


@pytest.mark.parametrize(
    ("fields", "found"),
    [
        ({"acquisition time": "2022-07-01T10:11:12.5+02:00"}, "2022-07-01T08:11:12Z"),
        ({"TIFFTAG_DATETIME": "2022:07:01 10:11:12"}, "2022-07-01T10:11:12Z"),
        ({"date": 20220701}, "2022-07-01"),
        ({"date": "2022/07/01", "time": "10:11:12 UTC"}, "2022-07-01T10:11:12Z"),
        ({"acquisition date": "DATE(dd-mm-yyyy): 01-07-2022", "date": "2020-01-01"}, "2022-07-01"),
        ({"NC_GLOBAL#time_coverage_start": "2022-07-01"}, "2022-07-01"),
        ({"date_created": "2022-07-01"}, None),
        ({"spacecraft date": "2022-07-01", "emit_date": "2022-07-01", "exif_time": "2022-07-01"}, None),
        ({"date": 2022}, None),
    ],
)
def test_a_day_or_moment_is_read(fields: dict[str, object], found: str | None) -> None:
    """Whole keys are tried in the order of trust; the creation of a file is no acquisition."""
    assert acquired_of(fields).text == found


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("05/06/2019", "no whole day"),
        ("2022-W26", "no whole day"),
        ("1970-01-01", "before 1971"),
        ("2022-07-03", "in the future"),
    ],
)
def test_a_doubtful_day_is_left_out_with_a_note(text: str, words: str) -> None:
    """The note names field and text."""
    text_of, notes = acquired_of({"date": text}, datetime(2022, 7, 1, tzinfo=UTC))
    assert text_of is None
    assert f"date = {text!r} is not used" in notes[0]
    assert words in notes[0]


def test_another_day_is_noted() -> None:
    """The first key counts. The day of the last change of a file is no other day of acquisition."""
    fields = {
        "acquisition time": "2022-07-01T23:59:00",
        "date": "2022-07-03",
        "TIFFTAG_DATETIME": "2023:01:01 00:00:00",
    }
    text, notes = acquired_of(fields)
    assert text == "2022-07-01T23:59:00Z"
    assert [note for note in notes if "another day," in note] == [
        "date states another day, 2022-07-03, than acquisition time, which counts"
    ]
