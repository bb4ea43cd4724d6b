"""What `ls`, `gc`, `explain` and `verify` do: storage does the work, this says where and with which exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.archive.contents import contents, explanation, verdict
from flows.archive.tables import show_clearance, show_contents, show_explanation, show_repair, show_verdict
from flows.terminal.progress import StageProgress
from flows.terminal.shown_text import on_stdout
from pipeline.errors import SettingsError
from storage.archive.archive import Archive
from storage.archive.whole_files import to_json
from storage.maintenance.garbage import Removal, clear_up
from storage.maintenance.repair import Repaired, Rerun
from storage.maintenance.verification import Finding
from storage.remote.opening import open_archive, put_back_archive, repair_archive, verify_archive

DONE, FAILED, PARTLY = 0, 1, 3


def run_ls(archive: str | Path, *, as_json: bool = False) -> int:
    """List runs and stores of an archive on stdout."""
    content = contents(open_archive(archive, create=False, write=False))
    _put_out(content, show_contents, as_json=as_json)
    return DONE


def run_gc(
    archive: str | Path,
    console: Console,
    *,
    keep_days: float = 1.0,
    raw_too: bool = False,
    dry_run: bool = False,
    as_json: bool = False,
) -> int:
    """Remove what no run names; progress on ``console``, what went (or would go) on stdout."""
    opened = open_archive(archive, create=False, write=not dry_run)
    with StageProgress(console, {"gc": "clearing up"}) as bars:

        def progress(removal: Removal, done: float) -> None:
            bars.show("gc", done, removal.uri)

        done = clear_up(opened, keep_days=keep_days, raw_too=raw_too, dry_run=dry_run, progress=progress)
    content = {
        "archive": opened.name,
        "dry_run": dry_run,
        "bytes": done.size,
        "removals": [asdict(removal) for removal in done.removals],
        "kept": done.kept,
        "obstacle": done.obstacle,
    }
    _put_out(content, show_clearance, as_json=as_json)
    return DONE if done.obstacle is None else PARTLY


def run_explain(archive: str | Path, product: str, *, as_json: bool = False) -> int:
    """Tell on stdout how a product came about, and what changed since the version before."""
    opened = open_archive(archive, create=False, write=False)
    _put_out(explanation(opened, product), show_explanation, as_json=as_json)
    return DONE


def run_verify(
    archive: str | Path, console: Console, *, remake: bool = False, rerun: Rerun | None = None, as_json: bool = False
) -> int:
    """Read an archive again; with ``remake`` have what is broken made anew by ``rerun`` (settings in, a run out)."""
    opened = open_archive(archive, create=False, write=remake)
    if remake:
        with opened.in_use(alone=True) as alone:
            if alone:
                put_back_archive(opened)
    findings = _read_again(opened, console)
    bad = [finding for finding in findings if finding.problem is not None]
    content = verdict(opened, findings, _versions() if bad else {})
    done = None
    if bad and remake:
        if not as_json:
            show_verdict(content, console)
        done = repair_archive(opened, bad, rerun or _survey_again(opened, console), versions=_versions())
        content["repair"] = _repaired(done)
    _put_out(content, show_verdict if done is None else show_repair, as_json=as_json)
    if done is None:
        return FAILED if bad else DONE
    stray = any(finding.kind in ("stray", "growing", "unreadable") for finding in bad)
    return DONE if done.complete and not stray else PARTLY if done.remade or done.dropped else FAILED


def check_outside(out: Path, archive: Archive) -> Path:
    """The folder ``out`` whole, if it does not lie in the archive, where nothing else belongs (SettingsError)."""
    folder = out.resolve()
    if folder.is_relative_to(archive.root.resolve()):
        raise SettingsError(f"--out {folder} lies in the archive, where nothing else belongs; choose another folder")
    return folder


def _survey_again(archive: Archive, console: Console) -> Rerun:
    def rerun(settings: dict[str, Any]) -> None:
        from flows.publish.survey_command import run_survey
        from flows.settings.load import of_this_version, parse_settings
        from flows.settings.survey_settings import OF_THE_MACHINE

        here = {**of_this_version(settings), "out": archive.name, **dict.fromkeys(OF_THE_MACHINE)}
        run_survey(parse_settings(here), console)

    return rerun


def _versions() -> Mapping[str, int]:
    from flows.survey.stage import versions

    return versions()


def _read_again(archive: Archive, console: Console) -> list[Finding]:
    with StageProgress(console, {"verify": "reading again"}) as bars:
        findings = verify_archive(archive, lambda uri, done: bars.show("verify", done, uri))
        bars.show("verify", 1.0, ended=True)
    return findings


def _repaired(done: Repaired) -> dict[str, Any]:
    return {
        "remade": done.remade,
        "dropped": done.dropped,
        "put_back": done.put_back,
        "failed": done.failed,
        "hopeless": done.plan.hopeless,
        "complete": done.complete,
    }


def _put_out(content: dict[str, Any], show: Callable[[dict[str, Any], Console], None], *, as_json: bool) -> None:
    if as_json:
        sys.stdout.write(to_json(content))
    else:
        show(content, on_stdout())
