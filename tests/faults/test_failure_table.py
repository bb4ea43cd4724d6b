"""A quick part of the failure table; ``python tests/faults`` makes the whole."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import pytest
import torch

from spectralzoom.models.weights.checksummed_files import load_checkpoint, save_checkpoint
from spectralzoom.models.weights.files import describe_weights, load_weights
from spectralzoom.pipeline.errors import WeightsError
from tests.faults import disk_full, lost_lines, many_writers, mutated_files, small_survey
from tests.faults.cube_files import FORMATS
from tests.faults.fault_table import HEADINGS, Row, run_table
from tests.faults.small_survey import Subject, stored


@pytest.mark.parametrize(("count", "code"), [(0, 1), (1, 0)])
def test_a_row_without_tries_is_not_met(count: int, code: int) -> None:
    """A comparison of 0 items finds no difference and proves nothing, so the exit code is 1."""
    row = Row("lines", "compared", count, "equal", f"0 of {count} differ", True)
    assert run_table(["lines"], "", "", {"lines": lambda quick: [row]}, (), HEADINGS) == code


def test_a_full_disk_ends_in_one_message_and_a_rerun_completes(subject: Subject) -> None:
    """The disk fills at each kind of file; the archive verifies, and the rerun on a larger disk is bit-identical."""
    found = disk_full.fill_at_places(subject, 1, mounted=disk_full.can_mount())
    assert found.wrong == []
    assert found.told == len(disk_full.KINDS)


def test_a_refused_call_ends_in_one_message_and_a_rerun_completes(subject: Subject) -> None:
    """The calls are random, of any library, and refused once or from then on."""
    found = disk_full.refuse_places(subject, 3, seed=3)
    assert found.wrong == []
    assert found.told >= 2
    assert len(subject.changing_calls) > 500
    # Zarr's writes must count too, as they are the most.
    names = {name for _, name, _ in subject.changing_calls}
    assert {"open", "write", "fsync", "fdatasync", "mkdir", "rename", "replace", "unlink"} <= names


def test_two_writers_share_stores_and_survive_a_kill(subject: Subject) -> None:
    """All others exit with 0, and the archive has one copy of each store."""
    found = many_writers.Writings()
    for number, kill in enumerate((False, True)):
        out = subject.folder / f"together-{number}"
        many_writers.write_together(subject, out, ((), ()), subject.truth, found, Random(number), kill=kill)
    assert found.wrong == []


def test_a_power_failure_loses_at_most_64_lines(tmp_path: Path) -> None:
    """Only lines since the last sync are lost, and the resumed capture has the same bytes."""
    found = lost_lines.try_power(30, tmp_path, seed=1)
    assert found.wrong == []
    assert 0 < max(found.lost) <= 64


def test_a_killed_capture_loses_no_line(tmp_path: Path) -> None:
    """The system keeps every line that was appended before SIGKILL."""
    found = lost_lines.try_kills(2, tmp_path, seed=1)
    assert found.wrong == []
    assert set(found.lost) == {0}


def _weights(path: Path) -> object:
    tensors = load_weights(path).segmenter.state_dict()
    return describe_weights(path).key, {name: value.numpy().tobytes() for name, value in tensors.items()}


def _checkpoint(path: Path) -> object:
    facts, tensors = load_checkpoint(path, "run") or ({}, {})
    return facts, {name: value.numpy().tobytes() for name, value in tensors.items()}


@pytest.mark.parametrize("read", [_weights, _checkpoint])
def test_flipped_bits_in_weights_and_checkpoints_are_refused(tmp_path: Path, weights: Path, read: Any) -> None:
    """Each flip, every other one in the header, is refused in one message, or reading gives the written values."""
    path = tmp_path / "flipped.safetensors"
    save_checkpoint(path, "run", {"course": {"step": 12, "seconds": 3.5}}, {"a": torch.randn(7, 5)})
    whole = (weights if read is _weights else path).read_bytes()
    path.write_bytes(whole)
    written, chance, refused = read(path), Random(1), list[str]()
    for end in (8, *(8 + int.from_bytes(whole[:8], "little"), len(whole)) * 37):
        flipped = bytearray(whole)
        flipped[chance.randrange(end)] ^= 1 << chance.randrange(8)
        path.write_bytes(flipped)
        try:
            assert read(path) == written
        except WeightsError as error:
            refused.append(str(error))
    assert len(refused) > 50
    assert all(str(path) in words and "\n" not in words for words in refused)


def test_mutated_headers_give_a_cube_or_one_error() -> None:
    """Each reading ends within 30 s, in memory bounded by the size of its files."""
    found = mutated_files.try_headers(300, seed=1)
    assert found.wrong == []
    assert found.read > 20  # else only the first check was tested
    assert found.refused > 20


@pytest.mark.filterwarnings("ignore::Warning")  # decoders may warn before they refuse
def test_mutated_files_give_a_cube_or_one_error() -> None:
    """Each reading ends within 30 s, in memory bounded by the size of its files."""
    found = mutated_files.try_files(8 * len(FORMATS), seed=7).values()
    assert [line for tally in found for line in tally.wrong] == []
    assert min(tally.read + tally.refused for tally in found) == 8
    assert sum(tally.refused for tally in found) > 20
    assert sum(tally.read for tally in found) > 10


def test_the_checks_find_damage(subject: Subject) -> None:
    """They find a cut store, a lost store, and an error without advice."""
    out = subject.folder / "damaged"
    subject.surveyed(out)
    before = stored(out)
    first = next(path for path in sorted((out / "stages/segment").rglob("*")) if path.is_file() and path.suffix == "")
    first.write_bytes(first.read_bytes()[:-1])
    wrong = small_survey.wrong_after_fault(subject, out, {**before, "stages/segment/gone": {}})
    assert any("bytes, expected" in one for one in wrong)
    assert any("was lost" in one for one in wrong)
    assert not subject.nursery.run(["survey", "--scene", "nowhere.png", "--out", str(out)]).told
