"""A working copy with a flipped bit is not sent to a bucket, and a flipped bit in a bucket does not come back."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

from spectralzoom.storage.remote.objects import Objects
from tests.faults.metadata_flips import CURE, Flip, aimed_flips, each_kind
from tests.faults.whole_survey import Whole, stored_files
from tests.flows.conftest import CommandLine, command_line  # noqa: F401 - a fixture
from tests.object_server import overwrite


@pytest.mark.usefixtures("bucket")
def test_a_flipped_bit_in_metadata_is_not_sent(
    whole: Whole,
    bucket: str,
    tmp_path: Path,
    command_line: CommandLine,  # noqa: F811
) -> None:
    """Of every other kind of store: the message names it and the cure, and its manifest is not there.

    After the cure the rest is sent, and a pull gives every file as it was.
    """
    for number, flip in enumerate(each_kind(aimed_flips(whole), 1)[::2]):
        out, place = whole.copy(tmp_path / "damaged"), f"{bucket}/{number}"
        flip.apply(out)
        command_line("push", out, place).refused(1, f"{flip.uri}.*{CURE}")
        assert f"{flip.uri}/manifest.json" not in Objects(place).listing(), flip
        shutil.rmtree(out)
    assert command_line("push", whole.out, bucket).code == 0
    assert command_line("pull", bucket, tmp_path / "again").code == 0
    assert stored_files(tmp_path / "again") == whole.files


def test_a_flipped_bit_in_a_bucket_does_not_come_back(
    whole: Whole,
    bucket: str,
    tmp_path: Path,
    command_line: CommandLine,  # noqa: F811
) -> None:
    """Of each kind of store: the message names it, and nothing of it is in the archive."""
    objects = Objects(bucket)
    assert command_line("push", whole.out, bucket).code == 0
    for flip in each_kind(aimed_flips(whole), 1):
        ends = flip.name, "cleared.json"  # the manifest of a store without its files
        name = next(name for name in objects.listing() if name.startswith(flip.uri) and name.endswith(ends))
        written = objects.read(name)
        assert written is not None
        overwrite(objects, name, flipped(written, flip))
        out = whole.copy(tmp_path / "copy")
        shutil.rmtree(out / flip.uri)
        command_line("pull", bucket, out).refused(1, flip.uri)
        assert not (out / flip.uri).exists(), flip
        assert not list(out.rglob("*.part")), flip
        overwrite(objects, name, written)
        shutil.rmtree(out)


def flipped(content: bytes, flip: Flip) -> bytes:
    """Return the content with the other bit."""
    changed = bytearray(content)
    changed[flip.at] ^= 1 << flip.bit
    return bytes(changed)
