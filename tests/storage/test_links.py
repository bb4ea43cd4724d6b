"""Links in an archive that lead to a user's files and folders: none is followed but the archive and its stages."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spectralzoom.flows.local_server import ServerUnavailable, close_folder, local_server, private_files
from spectralzoom.flows.stages.capture import KEPT
from spectralzoom.pipeline.errors import ArchiveError, PipelineError
from spectralzoom.pipeline.source import Line
from spectralzoom.storage.arrays.spool import FetchedFiles, Spool
from spectralzoom.storage.store import Archive, stage_key
from spectralzoom.storage.whole_files import make_folder, open_own, write_new
from tests.storage.small_archive import make_store, problems, small_survey

KEY = stage_key("capture", 1, {})
SECRET = b"a user's file"


def spooled(archive: Archive) -> None:
    """Append a line to a spool."""
    with Spool.open(archive.root / "spool" / KEY, 2, 2, header={}, name="coarse") as spool:
        spool.append(Line(spool.count, np.zeros((2, 2), np.uint16), 0, 0, 0, 1, valid=True))
        list(spool.blocks())


def fetched(archive: Archive) -> None:
    """Append to files of a camera, and read them."""
    make_folder(archive.root / "spool" / KEY / KEPT, archive.root)
    kept = FetchedFiles(archive.root / "spool" / KEY / KEPT)
    for name in ("journal", "/data/raw_0"):
        kept.append(name, b"more")
        kept.read(name, 0, 99)


def made(archive: Archive) -> None:
    """Make, clear, make again and discard a store."""
    ref = make_store(archive, "capture", {}, [])
    archive.clear(ref)
    archive.discard(make_store(archive, "capture", {}, []).uri)


def served(archive: Archive) -> None:
    """Make the files of Prefect's server."""
    private_files(archive.root / ".prefect")


FOLDERS = [  # in the archive, and what would write into the folder that a link leads to
    (f"spool/{KEY}", spooled),
    (f"spool/{KEY}", fetched),
    (f"spool/{KEY}/{KEPT}", fetched),
    ("stages/capture", made),
    (f"stages/capture/{KEY}", made),
    (".prefect", served),
    (".prefect/storage", served),
    (".locks", made),
    ("runs", small_survey),
    ("spool", spooled),
]
FILES = [
    (f"spool/{KEY}/coarse.lines", spooled),
    (f"spool/{KEY}/{KEPT}/journal", fetched),
    (f"spool/{KEY}/{KEPT}/data%2Fraw_0", fetched),
    (f"spool/{KEY}/{KEPT}/data%2Fraw_0%sums", fetched),
    (f".locks/capture-{KEY}.lock", made),
    (".locks/use.lock", lambda archive: archive.in_use().__enter__()),
    (".prefect/password", served),
    (".prefect/prefect.db", served),
]
Writer = Callable[[Archive], object]


@pytest.mark.parametrize(("place", "write"), FOLDERS)
def test_a_link_to_a_folder_is_not_followed(tmp_path: Path, place: str, write: Writer) -> None:
    """The folder gets no file and keeps its mode; the error names the link."""
    (tmp_path / "archive/stages").mkdir(parents=True)
    outside = tmp_path / "outside"
    outside.mkdir(mode=0o755)
    link = tmp_path / "archive" / place
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(outside)
    with pytest.raises(PipelineError, match=rf"{link}.* is a link"):
        write(Archive.open(tmp_path / "archive"))
    assert list(outside.iterdir()) == []
    assert stat.S_IMODE(outside.stat().st_mode) == 0o755


@pytest.mark.parametrize("leads", ["to a file", "nowhere"])
@pytest.mark.parametrize(("place", "write"), FILES)
def test_a_link_to_a_file_is_not_followed(tmp_path: Path, place: str, write: Writer, leads: str) -> None:
    """A file keeps its bytes, and none appears where a link leads to."""
    (tmp_path / "archive/stages").mkdir(parents=True)
    outside = tmp_path / "outside"
    if leads == "to a file":
        outside.write_bytes(SECRET)
    link = tmp_path / "archive" / place
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(outside)
    with pytest.raises(PipelineError, match=f"{link}"):
        write(Archive.open(tmp_path / "archive"))
    assert outside.exists() == (leads == "to a file")
    assert not outside.exists() or outside.read_bytes() == SECRET


def test_a_file_of_a_fixed_name_for_a_copy_is_not_used(tmp_path: Path) -> None:
    """The database is copied under a new name, so that a link of the old one leads nowhere."""
    outside, home = tmp_path / "outside", tmp_path / "home"
    outside.write_bytes(SECRET)
    home.mkdir(mode=0o700)
    (home / "prefect.part").symlink_to(outside)
    with pytest.raises(ArchiveError, match="is a link or belongs to another user"):
        private_files(home)
    assert outside.read_bytes() == SECRET


def test_the_stages_and_the_archive_may_be_links_to_a_data_disk(tmp_path: Path) -> None:
    """All work is done there; a link below is refused as elsewhere."""
    for name in ("disk", "other"):
        (tmp_path / name).mkdir()
    (tmp_path / "archive").mkdir()
    (tmp_path / "archive/stages").symlink_to(tmp_path / "disk")
    (tmp_path / "way").symlink_to(tmp_path / "archive")
    archive = Archive.open(tmp_path / "way")
    small = small_survey(archive)
    archive.clear(small.raw)
    archive.discard(small_survey(archive, seed=1, named=False).map.uri)
    assert problems(archive) == []
    assert {path.name for path in (tmp_path / "disk").iterdir()} == {"capture", "rectify", "segment"}
    (tmp_path / "disk/score").symlink_to(tmp_path / "other")
    with pytest.raises(ArchiveError, match="score is a link"):
        make_store(archive, "score", {}, [])
    (tmp_path / "archive/stages").unlink()
    (tmp_path / "archive/stages").symlink_to(tmp_path / "nothing")
    with pytest.raises(ArchiveError, match="is a link that leads to no folder"):
        Archive.open(tmp_path / "archive")


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o755])
def test_a_password_that_others_may_know_is_replaced(tmp_path: Path, mode: int) -> None:
    """Of a folder that was open to them; afterwards it is closed, and the password stays."""
    home = tmp_path / "home"
    home.mkdir()
    (home / "password").write_text("spectralzoom:known")
    home.chmod(mode)
    first = private_files(home)
    assert first != "spectralzoom:known"
    assert private_files(home) == first
    assert stat.S_IMODE(home.stat().st_mode) == 0o700


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files to another user")
@pytest.mark.parametrize("name", ["", "password", "prefect.db", "storage/lease"])
def test_files_of_another_user_are_refused(tmp_path: Path, name: str) -> None:
    """The folder itself, or one file in it; the survey then runs without Prefect."""
    home = tmp_path / ".prefect"
    (home / "storage").mkdir(parents=True)
    (home / "storage/lease").touch()
    private_files(home)
    os.chown(home / name, 65534, 65534)
    with pytest.raises(ArchiveError, match=rf"{home / name} is a link or belongs to another user"):
        close_folder(home)
    with (
        pytest.raises(ServerUnavailable, match=r"cannot use its folder .* belongs to another user"),
        local_server(home),
    ):
        pass


@pytest.mark.parametrize("mode", ["rb", "ab", "r+b", "xb", "a"])
def test_a_pipe_is_refused_at_once(tmp_path: Path, mode: str) -> None:
    """It is neither read nor waited for."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match=r"no file of its own|No such device|File exists"):
        open_own(tmp_path / "pipe", mode)
    with pytest.raises(FileExistsError):
        write_new(tmp_path / "pipe", "")


SWAPS = """
import os, sys
from pathlib import Path
place, outside = Path(sys.argv[1]), sys.argv[2]
print("begun", flush=True)
while True:  # a folder, then a link to the user's folder in its place
    for make in (lambda: place.mkdir(), lambda: place.symlink_to(outside)):
        try:
            make()
        except OSError:
            pass
        try:
            place.rename(place.with_name("away"))
            os.unlink(place.with_name("away"))
        except OSError:
            os.system(f"rm -rf '{place.with_name('away')}'")
"""


def test_a_link_that_another_process_puts_there_meanwhile_is_not_followed(tmp_path: Path) -> None:
    """It exchanges the folder of a spool for a link again and again: no line lands outside."""
    archive, outside = Archive.open(tmp_path / "archive"), tmp_path / "outside"
    outside.mkdir()
    (archive.root / "spool").mkdir()
    command = [sys.executable, "-c", SWAPS, str(archive.root / "spool" / KEY), str(outside)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        refused = 0
        for _ in range(200):
            try:
                spooled(archive)
            except (PipelineError, OSError):
                refused += 1
        other.kill()
    assert list(outside.iterdir()) == []
    assert refused > 0
