"""`spectralzoom plan` of the paper's field: how long it takes, and its estimates against what surveys took.

As a row of the benchmarks it surveys small fields; python tests/benchmarks/bench_plan.py --full surveys 1280 x 1280 px,
a 1/64 part of the field, and prints every stage. --keep FOLDER keeps the archives (and uses them, if they are there).
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

if __name__ == "__main__":  # as a command of its own; one thread, as the figures are meant
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_name, "1")
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from measure import ROOT, Row

if TYPE_CHECKING:
    from storage.archive.manifests import Cost

FIELD_PX, PART_PX = 10240, 1280
SMALL_PX, LARGER_PX = (320, 640), 960
STORES = 200
TURNS = 3
MOST_S, MOST_OFF = 2.0, 0.25


@dataclass(frozen=True)
class Compared:
    """Estimates of one stage beside what it took: wall and processor seconds, bytes."""

    stage: str
    wall: tuple[float, float]
    cpu: tuple[float, float]
    size: tuple[float, float]


def rows() -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for side in SMALL_PX:
            _survey(folder / "small", side)
        larger = _survey(folder / "larger", LARGER_PX)
        found = _compare(folder / "small", LARGER_PX, larger)
        _print_table(f"{LARGER_PX} px by records of {' and '.join(map(str, SMALL_PX))} px", found)
        words = f"{LARGER_PX} px by two smaller fields"
        return [*_clocks(folder, folder / "small"), *_sums(words, found, quiet=False)]


def _clocks(folder: Path, small: Path) -> list[Row]:
    """The whole command, with an archive that is not there and with one of many stores."""
    many = _many_stores(folder / "many", small)
    what = f"plan of {FIELD_PX} x {FIELD_PX} x 270"
    return [_clock(f"{what}, empty archive", folder / "none"), _clock(f"{what}, {many} stores", folder / "many")]


def _clock(what: str, archive: Path) -> Row:
    command = [sys.executable, "-m", "flows.cli.main", "plan", "--scene", "farm", "--out", str(archive), "--json"]
    command += ["--no-controls", "--size", f"{FIELD_PX}x{FIELD_PX}"]
    walls, cpus = [], []
    for _ in range(TURNS):
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        walls.append(time.perf_counter() - began)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpus.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    wall = min(walls)
    return Row(what, f"{wall:.2f} s", f"< {MOST_S:g} s", wall < MOST_S, f"{min(cpus):.2f} s of processor")


def _survey(archive: Path, side: int) -> dict[str, Cost]:
    """Survey a square of the farm, or find that it was; gives its stages by name."""
    from rich.console import Console

    from flows.publish.survey_command import run_survey
    from flows.survey import draw_class_map
    from flows.tasks.open_survey import OpenSurvey
    from flows.tasks.run import open_run

    settings = _settings(archive, side)
    run_survey(settings, Console(quiet=True))
    again = OpenSurvey(open_run(settings))
    draw_class_map(again)
    stages = {}
    for name, ref in again.products.items():
        cost = again.run.archive.cost(ref)
        if cost is not None:
            stages[name] = cost
    return stages


def _plan(archive: Path, side: int, clock: str = "wall_s") -> dict[str, Any]:
    """The plan's content; its seconds by what the records say of one clock."""
    from flows.archive.plan_command import plan_content
    from storage.archive.manifests import cost_of

    def timed(manifest: dict[str, Any]) -> Cost | None:
        cost = cost_of(manifest)
        return None if cost is None else replace(cost, wall_s=getattr(cost, clock))

    with patch("storage.archive.records.cost_of", timed):
        return plan_content(_settings(archive, side))


def _settings(archive: Path, side: int) -> Any:
    from flows.settings.load import load_settings

    flags = {"scene": "farm", "size": f"{side}x{side}", "out": str(archive), "engine": "plain", "controls": False}
    return load_settings(None, flags)


def _many_stores(archive: Path, like: Path) -> int:
    """Fill an archive with copies of another's stores, of other seeds; gives their number."""
    from storage.archive.archive import Archive
    from storage.archive.lineage import Catalogue
    from storage.archive.staging import MANIFEST_NAME

    catalogue, target = Catalogue.read(like), Archive.open(archive)
    rounds = -(-STORES // len(catalogue.stores))
    for seed in range(1, rounds + 1):
        keys: dict[str, str] = {}
        for uri in catalogue.inputs_first(catalogue.stores):
            store = catalogue.stores[uri]

            def copy(path: Path, source: Path = store.ref.path) -> None:
                shutil.copytree(source, path, dirs_exist_ok=True, copy_function=os.link)
                (path / MANIFEST_NAME).unlink()

            params = {**store.params, "copy": seed}
            inputs = [keys[key] for key in store.inputs]
            ref, _ = target.produce(store.ref.stage, copy, version=store.version, params=params, inputs=inputs)
            keys[store.ref.key] = ref.key
    return len(target.refs())


def _compare(archive: Path, side: int, took: dict[str, Cost], times: float = 1.0) -> list[Compared]:
    """Estimates of a plan beside ``times`` what the stages of a survey took."""
    wall, cpu = (_plan(archive, side, clock)["stages"] for clock in ("wall_s", "cpu_s"))
    return [
        Compared(
            one["stage"],
            (one["seconds"], times * took[one["stage"]].wall_s),
            (other["seconds"], times * took[one["stage"]].cpu_s),
            (one["bytes"], times * took[one["stage"]].size),
        )
        for one, other in zip(wall, cpu, strict=True)
        if one["stage"] in took and one["seconds"] is not None
    ]


def _sums(words: str, found: list[Compared], *, quiet: bool) -> list[Row]:
    """Sums over the stages; wall seconds of two surveys can be held against each other on a quiet machine alone."""
    kinds = {
        "bytes": ([one.size for one in found], True),
        "processor seconds": ([one.cpu for one in found], True),
        "wall seconds": ([one.wall for one in found], quiet),
    }
    made = []
    for what, (pairs, judged) in kinds.items():
        share = sum(guess for guess, _ in pairs) / sum(real for _, real in pairs)
        worst = max(zip(found, pairs, strict=True), key=lambda one: abs(_ratio(one[1]) - 1))
        made.append(
            Row(
                f"estimated {what} of {words}, over measured",
                f"{share:.2f}",
                "0.75 to 1.25" if judged else "",
                abs(share - 1) <= MOST_OFF if judged else None,
                f"farthest off: {worst[0].stage} {_ratio(worst[1]):.2f}",
            )
        )
    return made


def _ratio(pair: tuple[float, float]) -> float:
    return pair[0] / pair[1]


def _print_table(title: str, found: list[Compared]) -> None:
    print(f"{title}: estimated, measured, ratio of wall and processor seconds and bytes")
    for one in found:
        wall, cpu = (f"{guess:10.2f}{real:10.2f} s{guess / real:6.2f}" for guess, real in (one.wall, one.cpu))
        size = f"{one.size[0] / 1e6:12.3f}{one.size[1] / 1e6:12.3f} MB{_ratio(one.size):6.2f}"
        print(f"  {one.stage:16}{wall} |{cpu} |{size}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--full", action="store_true", help="survey 1280 x 1280 px instead of small fields")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where the archive of the part stays")
    given = parser.parse_args()
    if not given.full:
        _print_rows(rows())
        return
    with tempfile.TemporaryDirectory() as name:
        part = (given.keep or Path(name)) / "part"
        took = _survey(part, PART_PX)
        found = _compare(part, FIELD_PX, took, times=(FIELD_PX / PART_PX) ** 2)
        _print_table(f"{FIELD_PX} px by a record of {PART_PX} px, beside 64 times that record", found)
        # Judging is no part of a survey, and reads the whole field at once.
        survey = [one for one in found if one.stage != "evaluate"]
        _print_rows(_sums(f"{FIELD_PX} px with judging", found, quiet=True))
        _print_rows(_sums(f"{FIELD_PX} px without judging", survey, quiet=True))
        _print_rows(_clocks(Path(name), part))


def _print_rows(found: list[Row]) -> None:
    for row in found:
        goal = "" if row.met is None else f"goal {row.goal}: {'met' if row.met else 'missed'}; "
        print(f"{row.what}: {row.figure} ({goal}{row.peers})")


if __name__ == "__main__":
    main()
