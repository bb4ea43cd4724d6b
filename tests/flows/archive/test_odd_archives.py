"""Untrusted archives: commands stay inside, read the valid part, and refuse the rest."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from spectralzoom.flows.cli.main import main
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import sha256
from tests.storage.small_archive import Small, rewrite, small_survey

pytestmark = pytest.mark.usefixtures("no_effects")
SECRET = b"not of this archive"
LEADS = ("../../../secret", "/etc/passwd", "stages/../../secret", "secret\0", "..", "")


def list_file(small: Small, lead: str) -> None:
    """Make a store list a file outside of it."""
    manifest = small.mosaic.path / "manifest.json"
    listed = json.loads(manifest.read_text())["files"]
    rewrite(manifest, files=listed | {lead: [len(SECRET), "0" * 64]})


def name_products(small: Small, lead: str) -> None:
    """Point a run's products, stages and dependencies outside of the archive."""
    receipt = json.loads((small.run / "receipt.json").read_text())
    receipt["products"] = {"class_map": lead, "mosaic": f"stages/rectify/{lead}"}
    receipt["stages"] = [{"name": lead, "key": lead, "state": "ran", "manifest_sha256": "0" * 64}]
    text = json.dumps(receipt).encode()
    (small.run / "receipt.json").write_bytes(text)
    entry = [len(text), sha256(small.run / "receipt.json")]
    rests_on = {lead: "0" * 64, f"runs/{lead}": "0" * 64}
    rewrite(small.run / "manifest.json", files={"receipt.json": entry}, rests_on=rests_on)


CHANGES = (
    list_file,
    lambda small, lead: rewrite(small.mosaic.path / "manifest.json", inputs=[lead, f"capture/{lead}"]),
    lambda small, lead: rewrite(small.mosaic.path / "manifest.json", stage=lead, key=lead),
    name_products,
)


@pytest.mark.parametrize(
    ("change", "lead"),
    [(one, lead) for number, one in enumerate(CHANGES) for lead in (LEADS[number], LEADS[-1 - number])],
)
def test_no_command_leaves_the_archive(
    tmp_path: Path, change: Callable[[Small, str], None], lead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each command ends with output or one message; files beside the archive stay, and are not shown."""
    root = tmp_path / "archive"
    change(small_survey(Archive.open(root), simulated=False), lead)
    secrets = [tmp_path / "secret", root / "secret", root / "stages" / "secret"]
    for path in secrets:
        path.write_bytes(SECRET)
    for verb in (
        ["ls"],
        ["explain", "class_map"],
        ["explain", "rectify"],
        ["verify"],
        ["export"],
        ["gc", "--keep-days", "0", "--raw-too"],
        ["gc", "--damaged"],
    ):
        with pytest.raises(SystemExit) as ended:
            main([verb[0], str(root), *verb[1:]])
        assert ended.value.code in (0, 1, 2, 3), verb
        shown = capsys.readouterr()
        assert "defect" not in shown.err + shown.out, (verb, shown.err)
        assert SECRET.decode() not in shown.err + shown.out
        assert secrets[0].read_bytes() == SECRET, verb
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["archive", "secret"]
