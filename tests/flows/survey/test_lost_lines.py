"""Lines of a broken capture that rotted before it went on: the survey is the one that nothing disturbed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import RigError
from pipeline.source import Line
from storage.archive.archive import Archive
from storage.arrays.spool import Spool
from storage.remote.opening import verify_archive
from tests.storage.small_archive import flip

BROKEN_AT = 21


def test_lost_lines_are_rendered_again(survey_png: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bits flip in index, header and numbers: verify tells of it, and the same command ends with the same stores."""
    survey_png(tmp_path / "whole")
    append, appended = Spool.append, [0]

    def breaks(spool: Spool, line: Line) -> None:
        append(spool, line)
        appended[0] += 1
        if appended[0] == BROKEN_AT:
            raise RigError("unplugged")

    with monkeypatch.context() as patch:
        patch.setattr(Spool, "append", breaks)
        with pytest.raises(RigError, match="unplugged"):
            survey_png(tmp_path / "broken")
    (index,) = (tmp_path / "broken" / "spool").glob("*/*.index")
    numbers = index.with_suffix(".bil")
    ends = [at for at, byte in enumerate(index.read_bytes()) if byte == ord("\n")]
    for path, at in ((index, 40), (index, ends[3] - 30), (index, ends[9]), (numbers, numbers.stat().st_size // 2)):
        flip(path, at)
    told = [one for one in verify_archive(Archive.open(tmp_path / "broken")) if one.problem is not None]
    assert {(one.uri, one.kind) for one in told} == {(f"spool/{index.parent.name}", "growing")}
    survey_png(tmp_path / "broken")
    before, after = (Archive.open(tmp_path / name) for name in ("whole", "broken"))
    assert [ref.uri for ref in after.refs()] == [ref.uri for ref in before.refs()]
    for ref in before.refs("capture"):
        assert after.manifest(after.ref("capture", ref.key))["files"] == before.manifest(ref)["files"]
    assert {one.kind for one in verify_archive(after)} == {"whole"}
