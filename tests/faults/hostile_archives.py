"""Put something else where an archive has a file or a folder: ``python tests/faults hostile_archives``.

Every command must end within its time, with exit code 0 or one message, and change nothing outside of the archive. A
link that leads out of it is not followed. Without the strange thing, one survey completes the archive.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Timer

import spectralzoom
from tests.faults.cube_files import TookTooLongError, at_most
from tests.faults.fault_table import Row, reported_wrong
from tests.faults.nursery import Child, Ended, Nursery
from tests.faults.small_survey import Subject, prepare, problems, stored, words
from tests.faults.whole_survey import Whole, asked, maps_of, numbers_of, other_receipt, stored_files, survey_whole

LONGEST_S = 60  # later ends count as hanging, also on a machine with much else to do
CODES = {"verify": (0, 1), "gc": (0, 1, 3)}  # beside 2, an argument; of others 0 and 1
SECRET = "not of this archive"


def _file(place: Path, outside: Path) -> None:
    place.write_text(SECRET)


def _folder(place: Path, outside: Path) -> None:
    place.mkdir()


def _pipe(place: Path, outside: Path) -> None:
    os.mkfifo(place)


def _dangling(place: Path, outside: Path) -> None:
    place.symlink_to(outside / "nothing")


def _loop(place: Path, outside: Path) -> None:
    place.symlink_to(place.name)


def _outside(place: Path, outside: Path) -> None:
    place.symlink_to(outside / "moved")  # where what was here is, unchanged


KINDS: dict[str, Callable[[Path, Path], None]] = {
    "file": _file,
    "folder": _folder,
    "pipe": _pipe,
    "dangling link": _dangling,
    "link to itself": _loop,
    "link outside": _outside,
}
PLACES = {  # address in the archive, and the kinds that are no usual sight there
    "stages": "file, pipe, dangling link, link to itself",
    "stages/segment": "file, pipe, dangling link, link to itself, link outside",
    "{segment}": "file, folder, pipe, dangling link, link to itself, link outside",
    "{segment}.part": "file, pipe, dangling link, link to itself, link outside",
    "{segment}/manifest.json": "folder, pipe, dangling link, link to itself, link outside",
    "{segment}/spectra.json": "folder, pipe, dangling link, link to itself, link outside",
    "{segment}/class_map.zarr": "file, pipe, dangling link, link to itself, link outside",
    "{segment}/class_map.zarr/zarr.json": "folder, pipe, dangling link, link to itself, link outside",
    "{segment}/class_map.zarr/classes/c.0.0": "folder, pipe, dangling link, link to itself, link outside",
    "{effects}/effects.json": "folder, pipe, dangling link, link outside",
    "runs": "file, pipe, dangling link, link to itself, link outside",
    "{run}": "file, folder, pipe, dangling link, link to itself, link outside",
    "{run}.part": "file, pipe, dangling link, link outside",
    "{run}/manifest.json": "folder, pipe, dangling link, link to itself, link outside",
    "{run}/receipt.json": "folder, pipe, dangling link, link to itself, link outside",
    "spool": "file, pipe, dangling link, link to itself",
    "spool/{capture}": "file, pipe, dangling link, link outside",
    ".locks": "file, pipe, dangling link, link to itself",
    ".locks/use.lock": "folder, pipe, dangling link, link to itself, link outside",
}
CASES = [(place, kind) for place, kinds in PLACES.items() for kind in kinds.split(", ")]


@dataclass
class Tries:
    """Count commands on strange archives."""

    places: int = 0
    commands: int = 0
    wrong: list[str] = field(default_factory=list)

    def told(self, called: str, ended: Ended, *, codes: Sequence[int] = (0, 1, 2)) -> None:
        """Note what is wrong with the end of a command."""
        self.commands += 1
        errors = [line for line in ended.text.splitlines() if line.startswith("error: ")]
        if ended.code == -9:
            self.wrong.append(f"{called}: hangs")
        elif "Traceback" in ended.text or "defect" in ended.text or ended.code not in codes:
            self.wrong.append(f"{called}: exit {ended.code}: {ended.text[-400:]}")
        elif len(errors) > 1 or (ended.code in (1, 2) and not errors and 1 not in CODES.get(called.split()[0], ())):
            self.wrong.append(f"{called}: exit {ended.code} with {len(errors)} messages: {ended.text[-400:]}")
        elif ended.code == 0 and errors:
            self.wrong.append(f"{called}: exit 0 with an error: {ended.text[-400:]}")


def ended_in_time(child: Child) -> Ended:
    """Wait for a command, and kill it if it takes too long."""
    timer = Timer(LONGEST_S, child.kill)
    timer.start()
    try:
        return child.wait()
    finally:
        timer.cancel()


def readers(whole: Whole, out: Path, to: Path) -> dict[str, list[str]]:
    """Return the commands that read an archive, by name."""
    return {
        "ls": ["ls", str(out)],
        "explain latest": ["explain", str(out), "latest"],
        "explain class_map": ["explain", str(out), "class_map"],
        "verify": ["verify", str(out)],
        "export": ["export", str(out), whole.run, "--out", str(to)],
    }


def change(whole: Whole, out: Path, place: str, kind: str) -> tuple[str, Path]:
    """Copy the archive and put something strange into it; return its address and a folder outside of the archive."""
    whole.copy(out)
    outside = out.with_name(f"{out.name}-outside")
    outside.mkdir()
    (outside / "secret").write_text(SECRET)
    names = {name: next(uri for uri in whole.stores if f"/{name}/" in uri) for name in ("segment", "effects")}
    uri = place.format(run=whole.run, capture=next(u for u in whole.stores if "/capture/" in u).split("/")[2], **names)
    path = out / uri
    path.parent.mkdir(exist_ok=True)
    if path.exists():
        path.rename(outside / "moved")
    elif kind == "link outside":
        (outside / "moved").mkdir()
        (outside / "moved" / "file").write_text(SECRET)
    KINDS[kind](path, outside)
    return uri, outside


def tree(folder: Path) -> dict[str, bytes]:
    """Return the names in a folder, and the content of its files."""
    paths = sorted(folder.rglob("*"))
    return {path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else b"" for path in paths}


def try_place(whole: Whole, out: Path, place: str, kind: str, tries: Tries) -> None:
    """Run every command on an archive with something strange in it; then remove that, and complete the archive."""
    tries.places += 1
    uri, outside = change(whole, out, place, kind)
    before = tree(outside)
    _run_readers(whole, out, uri, kind, tries)
    for name, command in _writers(out).items():
        ended = ended_in_time(whole.nursery.start(command))
        tries.told(f"{name} with a {kind} at {place}", ended, codes=(2, *CODES.get(name.split()[0], (0, 1))))
    after = tree(outside)
    if any(after.get(name) != content for name, content in before.items()):
        tries.wrong.append(f"a {kind} at {place}: something outside of the archive was changed")
    _undo(out / uri, outside)
    _complete(whole, out, f"a {kind} at {place}", tries)


def _run_readers(whole: Whole, out: Path, uri: str, kind: str, tries: Tries) -> None:
    to = out.with_name(f"{out.name}-exported")
    for name, command in readers(whole, out, to).items():
        ended = ended_in_time(whole.nursery.start(command))
        tries.told(f"{name} with a {kind} at {uri}", ended, codes=(2, *CODES.get(name.split()[0], (0, 1))))
        led = kind == "link outside" and "/segment/" in uri and not uri.endswith(".part")
        if name == "export" and ended.code == 0 and (led or maps_of(to) != whole.exported):
            tries.wrong.append(f"export with a {kind} at {uri}: reads what is not of the archive")
        if SECRET in ended.text:
            tries.wrong.append(f"{name} with a {kind} at {uri}: shows what is not of the archive")
    for store in (next(one for one in whole.stores if "/segment/" in one), whole.run):
        try:
            tries.commands += 1
            with at_most(LONGEST_S):
                found = numbers_of(out, store, whole.run.removeprefix("runs/"))
        except spectralzoom.Error:
            continue
        except TookTooLongError:
            tries.wrong.append(f"the package with a {kind} at {uri}: hangs")
        except Exception as error:  # any other exception is the defect that this test searches for
            tries.wrong.append(f"the package with a {kind} at {uri}: {type(error).__name__}: {error}")
        else:
            led = kind == "link outside" and uri.startswith(store) and not uri.endswith(".part")
            if led or found != whole.numbers[store]:
                tries.wrong.append(f"the package with a {kind} at {uri}: reads what is not of the archive")


def _undo(path: Path, outside: Path) -> None:
    """Remove the strange thing if it is still there, and put back what was there."""
    if path.is_symlink() or path.is_file() or path.is_fifo():
        path.unlink()
    elif path.is_dir() and not any(path.iterdir()):
        path.rmdir()
    if (outside / "moved").exists() and not path.exists() and path.parent.is_dir() and ".part" not in path.name:
        (outside / "moved").rename(path)


def _complete(whole: Whole, out: Path, called: str, tries: Tries) -> None:
    """Note what one survey leaves wrong: damage, missing or other files."""
    for command in (["gc", str(out), "--damaged"], asked(out), ["verify", str(out)]):
        ended = ended_in_time(whole.nursery.start(command))
        if ended.code != 0:
            tries.wrong.append(f"after {called}: {command[0]} ends with {ended.code}: {ended.text[-400:]}")
            return
    now = stored_files(out)
    others = [name for name in {**now, **whole.files} if now.get(name) != whole.files.get(name)]
    others += other_receipt(whole, out)
    if others:
        tries.wrong.append(f"after {called}: other than undisturbed: {', '.join(others[:5])}")


def try_places(whole: Whole, cases: Sequence[tuple[str, str]], folder: Path) -> Tries:
    """Try places and kinds, each in an archive of its own."""
    tries = Tries()
    for number, (place, kind) in enumerate(cases):
        try_place(whole, folder / f"hostile-{number}", place, kind, tries)
    return tries


# --- missing rights ---------------------------------------------------------------------------------------------------

RIGHTS = {  # address, and its mode
    "": 0o000,
    "stages": 0o000,
    "stages/segment": 0o555,
    "{segment}": 0o000,
    "{segment}/manifest.json": 0o000,
    "{segment}/class_map.zarr": 0o000,
    "{segment}/class_map.zarr/zarr.json": 0o000,
    "{effects}/effects.json": 0o000,
    "runs": 0o555,
    "{run}": 0o000,
    "{run}/receipt.json": 0o000,
    ".locks": 0o555,
    ".locks/use.lock": 0o000,
    "spool": 0o555,
}


def try_rights(whole: Whole, folder: Path, places: Sequence[str]) -> Tries:
    """Run every command without the rights to one place; then give them back, and complete the archive."""
    tries = Tries()
    names = {name: next(uri for uri in whole.stores if f"/{name}/" in uri) for name in ("segment", "effects")}
    for number, place in enumerate(places):
        out = Path(shutil.copytree(whole.out, folder / f"rights-{number}"))
        (out / "spool").mkdir(exist_ok=True)
        path = out / place.format(run=whole.run, **names)
        mode = path.stat().st_mode
        path.chmod(RIGHTS[place])
        for name, command in {**_writers(out), **readers(whole, out, out.with_name(f"{out.name}-exported"))}.items():
            ended = ended_in_time(whole.nursery.start(command, "obey_rights"))
            called = f"{name} without the rights to {place or 'the archive'}"
            tries.told(called, ended, codes=(2, *CODES.get(name.split()[0], (0, 1))))
            if not place and ended.code == 0:
                tries.wrong.append(f"{called}: it had them")
        tries.places += 1
        if path.exists():
            path.chmod(mode)
        _complete(whole, out, f"missing rights to {place}", tries)
    return tries


def _writers(out: Path) -> dict[str, list[str]]:
    """Return the commands that write to an archive, by name; after the last, what is damaged is removed."""
    gc = ["gc", str(out)]
    return {"survey": asked(out), "gc": [*gc, "--keep-days", "0"], "gc --damaged": [*gc, "--damaged"]}


# --- locks that fail, and locks that hold nothing ---------------------------------------------------------------------

LOCK_ERRORS = (errno.ENOSYS, errno.EIO, errno.EBADF)
OTHER = ("--policy", "sobel")  # another survey with the same first stages


def refuse_locks(whole: Whole, folder: Path, numbers: Sequence[int]) -> Tries:
    """Run commands while each lock fails with an error that nobody expected; then complete the archive."""
    tries = Tries()
    for number in numbers:
        out = whole.copy(folder / f"locks-{number}")
        for name, command in {**_writers(out), **readers(whole, out, out.with_name(f"{out.name}-exported"))}.items():
            ended = ended_in_time(whole.nursery.start(command, "fail_locks", number=number))
            tries.told(f"{name} with lock error {number}", ended, codes=CODES.get(name.split()[0], (0, 1)))
        tries.places += 1
        _complete(whole, out, f"lock error {number}", tries)
    return tries


def write_without_locks(subject: Subject, folder: Path, moments: Sequence[tuple[int, tuple[str, ...]]]) -> Tries:
    """Stop a survey before a changing call, run another command on the archive, and let the survey end.

    Locks hold nothing for both, as on some network drives.
    """
    tries = Tries()
    for number, (at, other) in enumerate(moments):
        out = folder / f"no-locks-{number}"
        first = subject.nursery.start(words(out), "stop_without_locks", root=str(out), at=at)
        stopped = _wait_until_stopped(first)
        command = [other[0], str(out), *other[1:]] if other[:1] == ("gc",) else words(out, *other)
        second = ended_in_time(subject.nursery.start(command, "fail_locks", number=0))
        if stopped:
            os.kill(first.pid, signal.SIGCONT)
        called = f"before call {at}, beside {' '.join(other) or 'the same survey'}"
        tries.places += stopped
        tries.told(f"survey {called}", ended_in_time(first), codes=(0, 1))
        tries.told(f"{command[0]} {called}", second, codes=CODES.get(command[0], (0, 1)))
        tries.wrong += [f"{called}: {one}" for one in problems(out)]
        again = subject.nursery.run(words(out))
        now = stored(out)
        others = [uri for uri, files in subject.truth.items() if now.get(uri) != files]
        if again.code != 0 or others or problems(out):
            tries.wrong.append(f"{called}: then exit {again.code}, {again.message}; other: {others}; {problems(out)}")
        shutil.rmtree(out)
    return tries


def _wait_until_stopped(child: Child) -> bool:
    """Wait until a process is stopped, or has ended; return whether it is stopped."""
    for _ in range(100 * LONGEST_S):
        state = Path(f"/proc/{child.pid}/stat").read_text().rpartition(") ")[2][0]
        if state in "TZ":
            return state == "T"
        time.sleep(0.01)
    raise TimeoutError(f"process {child.pid} has neither stopped nor ended")


def moments_of(subject: Subject, count: int, seed: int) -> list[tuple[int, tuple[str, ...]]]:
    """Return calls to stop at and commands that run meanwhile: publications, calls on spools and any calls by turns."""
    rng = random.Random(seed)
    calls = subject.changing_calls
    published = [number for number, name, path in calls if name == "rename" or path.name == "manifest.json"]
    spooled = [number for number, _, path in calls if path.parts[:1] == ("spool",)]
    pools = published, spooled, [number for number, *_ in calls]
    others = ((), OTHER, ("gc", "--keep-days", "0"), ("gc", "--damaged"))
    return [(rng.choice(pools[number % 3]), others[(0, 1, 0, 2, 0, 3)[number // 3 % 6]]) for number in range(count)]


def rows(quick: bool) -> Iterator[Row]:
    """Yield a row for all places."""
    with tempfile.TemporaryDirectory(prefix="hostile-") as name, Nursery(Path(name)) as nursery:
        subject = prepare(nursery)
        whole = survey_whole(subject)
        some = CASES[::7] if quick else CASES
        moments = moments_of(subject, 4 if quick else 80, 0)
        table = (
            ("strange archives", "file, folder, pipe or link in it", lambda: try_places(whole, some, Path(name))),
            ("missing rights", "no rights to one place", lambda: try_rights(whole, Path(name), list(RIGHTS))),
            ("failing locks", "ENOSYS, EIO, EBADF of each", lambda: refuse_locks(whole, Path(name), LOCK_ERRORS)),
            ("no locks", "two at once, one held", lambda: write_without_locks(subject, Path(name), moments)),
        )
        demanded = "exit 0 or one message, nothing outside is read or changed, and a survey completes the archive"
        for fault, injected, run in table:
            tries = run()
            found = f"{tries.places} archives, {tries.commands} commands, {reported_wrong(tries.wrong)}"
            yield Row(fault, injected, tries.places, demanded, found, not tries.wrong)
