"""A quick part of the failure table; the whole is ``python tests/faults``."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from tests.faults import checksummed_flips, disk_full, lost_lines, many_writers, mutated_files, small_survey
from tests.faults.cube_files import FORMATS
from tests.faults.fault_table import HEADINGS, Row, run_table
from tests.faults.small_survey import Subject, stored


@pytest.mark.parametrize(("count", "code"), [(0, 1), (1, 0)])
def test_a_row_that_tried_nothing_is_not_met(count: int, code: int) -> None:
    """Nothing of nothing differs; that shows nothing."""
    row = Row("lines", "compared", count, "equal", f"0 of {count} differ", True, 0.0)
    assert run_table(["lines"], "", "", {"lines": lambda quick: [row]}, (), HEADINGS) == code


def test_disk_full_under_spool_manifest_and_run(subject: Subject) -> None:
    """One message, an archive that verifies, and a rerun on a larger disk that is bit-identical."""
    mounted = disk_full.can_mount()
    found = disk_full.fill_at_places(subject, 1, mounted=mounted)
    assert found.wrong == []
    assert found.told == len(disk_full.KINDS)


def test_writes_refused_at_random_calls(subject: Subject) -> None:
    """Wherever in a survey, by whichever library, and whether once or for good."""
    found = disk_full.refuse_places(subject, 3, seed=3)
    assert found.wrong == []
    assert found.told >= 2
    assert len(subject.changing_calls) > 500
    # Writes of Zarr count too: else nothing would be refused where most is written.
    names = {name for _, name, _ in subject.changing_calls}
    assert {"open", "write", "fsync", "fdatasync", "mkdir", "rename", "replace", "unlink"} <= names


def test_two_writers_and_one_killed(subject: Subject) -> None:
    """The others end well, with one copy of everything."""
    found = many_writers.Writings()
    for number, kill in enumerate((False, True)):
        out = subject.folder / f"together-{number}"
        many_writers.write_together(subject, out, ((), ()), subject.truth, found, Random(number), kill=kill)
    assert found.wrong == []


def test_power_fails_in_a_capture(tmp_path: Path) -> None:
    """At most the lines since the last sync are lost, and the capture goes on to the same bytes."""
    found = lost_lines.try_power(30, tmp_path, seed=1)
    assert found.wrong == []
    assert 0 < max(found.lost) <= 64


def test_capture_killed(tmp_path: Path) -> None:
    """No line that was appended is lost."""
    found = lost_lines.try_kills(2, tmp_path, seed=1)
    assert found.wrong == []
    assert set(found.lost) == {0}


def test_bits_flipped_in_weights_and_checkpoints(tmp_path: Path) -> None:
    """Each is refused in one message, or read as it was written."""
    found = checksummed_flips.flip_bits(150, tmp_path, seed=1)
    assert found.wrong == []
    assert found.tried == found.refused + found.same == 150
    assert found.refused > 100


def test_mutated_headers_end_well() -> None:
    """Each header gives a cube or one clear error, soon, in about the memory that the files take."""
    found = mutated_files.try_headers(300, mutated_files.real_headers(), seed=1)
    assert found.wrong == []
    assert found.read > 20  # else nothing but the first check was tried
    assert found.refused > 20


@pytest.mark.filterwarnings("ignore::Warning")  # decoders may warn of what they then refuse
def test_mutated_files_end_well() -> None:
    """Each file gives a cube or one clear error, soon, in memory bounded by its size."""
    found = mutated_files.try_files(8 * len(FORMATS), seed=7).values()
    assert [line for tally in found for line in tally.wrong] == []
    assert min(tally.read + tally.refused for tally in found) == 8
    assert sum(tally.refused for tally in found) > 20
    assert sum(tally.read for tally in found) > 20


def test_a_fault_that_is_not_survived_is_seen(subject: Subject) -> None:
    """The judges find damage: a store of other bytes, one that is lost, and an error without advice."""
    out = subject.folder / "damaged"
    subject.surveyed(out)
    before = stored(out)
    first = next(
        path for path in sorted((out / "stages" / "segment").rglob("*")) if path.is_file() and path.suffix == ""
    )
    first.write_bytes(first.read_bytes()[:-1])
    wrong = small_survey.wrong_after_fault(subject, out, {**before, "stages/segment/gone": {}})
    assert any("bytes, expected" in one for one in wrong)
    assert any("was lost" in one for one in wrong)
    assert not subject.nursery.run(["survey", "--scene", "nowhere.png", "--out", str(out)]).told
