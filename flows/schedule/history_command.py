"""What `spectralzoom report` does: histories of an archive's fields as pages that open from disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.archive.commands import check_outside
from flows.schedule.field_history import FieldHistory, read_histories
from flows.schedule.history_page import render_history, render_index, way_to
from pipeline.errors import SettingsError
from storage.archive.archive import Archive
from storage.archive.whole_files import write_whole
from storage.remote.opening import open_archive


def run_report(archive: str | Path, field: str | None, out: Path, console: Console) -> dict[str, Any]:
    """Write one field's page, or an index with a page for each field beside it; what they show is given.

    Raises
    ------
    SettingsError : ``out`` is a folder, or lies in the archive.
    ArchiveError : no field is called so, or a file cannot be read or written.
    """
    opened = open_archive(archive, create=False, write=False)
    page = check_outside(out, opened)
    if page.is_dir():
        raise SettingsError(f"--out {out} is a folder, expected the file to write, such as {out}/history.html")
    if page.suffix.lower() not in (".html", ".htm"):
        raise SettingsError(f"--out {out}: expected a page's name that ends in .html")
    with console.status("reading the archive"):
        histories = read_histories(opened, field)
    if field is not None:
        written = [_write(histories[0], page, opened)]
        content = histories[0].to_dict()
    else:
        names = {one.field: f"{page.stem}-{one.field}{page.suffix}" for one in histories}
        written = [_write(one, page.with_name(names[one.field]), opened) for one in histories]
        write_whole(page, render_index(histories, opened.name, names))
        written.append(page)
        content = {"archive": opened.name, "fields": [one.to_dict() for one in histories]}
    console.print(f"  {escape(str(written[-1]))}", highlight=False, soft_wrap=True)
    return {**content, "pages": [str(path) for path in written]}


def _write(history: FieldHistory, page: Path, archive: Archive) -> Path:
    write_whole(page, render_history(history, "" if archive.in_bucket else way_to(archive.root, page)))
    return page
