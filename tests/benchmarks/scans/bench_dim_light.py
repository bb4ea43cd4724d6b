"""Real scenes with light taken away: what maps lose, by weights that know short exposures and by weights that do not.

Field frames (CWFID) that no weights were trained on or validated by, and the test pixels of Indian Pines. A quarter of
the light is an exposure of 25 ms, seen by the camera's own operator: footprint, shot and read noise, converter. The
plain scans of frames pass the same operator, not the mirror and its effects, whose rendering takes half a minute each.

`python tests/benchmarks/scans/bench_dim_light.py FILE ...` judges these weights; without files those that
SPECTRALZOOM_DIM_WEIGHTS names, with colons between them. What a file is for stands in its record.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[2])]

import numpy as np  # noqa: E402 - after the number of threads is set
from exposed_scans import CAMERA, ExposedScans  # noqa: E402
from measure import Row, data_folder, not_run  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.stats import t as student  # noqa: E402

from flows.evaluate.frames import Candidate, Look, look_at, open_frames, scene_of  # noqa: E402
from models.evaluation.metrics import LEVEL, confusion, mean_iou_of_each, paired_interval  # noqa: E402
from models.policies.policies import score_seats  # noqa: E402
from models.reading.inference import segment  # noqa: E402
from models.training.looks import REFERENCE_MS  # noqa: E402
from models.weights.files import Weights, load_weights  # noqa: E402
from pipeline.planning.plain_scans import MIOU, scan_words  # noqa: E402
from pipeline.planning.selection import frame_seats  # noqa: E402
from pipeline.simulator.scenes.scene import RasterScene  # noqa: E402

WEIGHTS = "SPECTRALZOOM_DIM_WEIGHTS"
DATA = {"cwfid": "cwfid", "Indian_pines_corrected": "indian_pines/Indian_pines_corrected.npy"}  # by what weights say
LIGHTS = {"1": 1.0, "1/4": 0.25, "1/8": 0.125, "1/32": 0.03125}  # of the reference exposure
SHARES = (0.1, 0.35)  # of the seats
RANDOM_DRAWS = 3
SECONDS = (7.0, 9.0, 13.0, 25.0)  # of surveys that choose their scan
STEPS, EXPOSURES_MS = (1, 2, 4), (100.0, 50.0, 35.0, 25.0, 17.0, 12.0, 8.0, 6.0, 4.0, 3.0)
SLACK = 0.3  # points of mIoU that such a survey may lie below the best plain scan tried
NONE, ALL = "none", "all"
Counts = NDArray[np.int64]  # (run, frame, class, class)


@dataclass(frozen=True)
class Judged:
    """Maps of one kind: confusion counts, and which weights each run is of, from 0."""

    counts: Counts
    of: NDArray[np.intp]  # (run,)

    @property
    def each(self) -> list[float]:
        """mIoU of all frames together by each of the weights, in percent."""
        runs = 100 * mean_iou_of_each(self.counts.sum(axis=1))
        return [float(runs[self.of == one].mean()) for one in np.unique(self.of)]

    @property
    def words(self) -> str:
        """The mean, and each of several weights."""
        several = f" ({' '.join(f'{one:.1f}' for one in self.each)})" if len(self.each) > 1 else ""
        return f"{np.mean(self.each):.1f}{several}"

    def beside(self, other: Judged) -> str:
        """Points above another kind, with an interval over frames, or over seeds where there is one scene."""
        if self.counts.shape[1] > 1:
            found = paired_interval(self.counts, other.counts, seeds=(self.of, other.of))
            assert found.low is not None
            assert found.high is not None
            return _points(*(100 * one for one in (found.difference, found.low, found.high)))
        each = np.subtract(self.each, other.each)
        if len(each) < 2:
            return f"{each[0]:+.1f}"
        wide = student.ppf((1 + LEVEL) / 2, len(each) - 1) * each.std(ddof=1) / np.sqrt(len(each))
        return _points(each.mean(), each.mean() - wide, each.mean() + wide)


def rows(paths: Sequence[Path] = ()) -> list[Row]:
    """Every data set that weights of both kinds were trained for."""
    named = [Path(name) for name in os.environ.get(WEIGHTS, "").split(os.pathsep) if name]
    files = [Candidate.of(path) for path in paths or named]
    if not files:
        return [Row("real scenes in dim light", f"not run: no weights, set {WEIGHTS} to files of both kinds")]
    return [row for law, place in DATA.items() for row in _rows_of(law, place, files)]


def _rows_of(law: str, place: str, files: Sequence[Candidate]) -> list[Row]:
    path, own = data_folder(place), [one for one in files if one.described.record.get("data") == law]
    bright, dim = ([one for one in own if _reads_dim(one) == kind] for kind in (False, True))
    if not path.exists():
        return [not_run(law, path)]
    if not bright or len(bright) != len(dim):
        return [Row(law, f"not run: {len(bright)} weights of full light and {len(dim)} of --darkest-ms, needs pairs")]
    data = open_frames(str(path), (), None, CAMERA, {})
    scenes = [scene for name in data.train if not _taught(scene := scene_of(data, name), name, law, own)]
    if not scenes:
        return [Row(law, "not run: the weights were trained on all of it, keep frames with --hold-out")]
    by_seed = [sorted(arm, key=lambda one: int(one.described.record["settings"]["seed"])) for arm in (bright, dim)]
    arms = [[load_weights(one.path) for one in arm] for arm in by_seed]
    found = list(_light_rows(f"{law}, {len(scenes)} scene{'s' if len(scenes) > 1 else ''}", *arms, scenes))
    recorded = [weights for weights in arms[1] if "scans" in weights.record]
    if not recorded:
        found.append(Row(f"{law}, survey --seconds", "not run: no weights with a record of plain scans"))
    return found + [row for weights in recorded for row in _scan_rows(law, weights, scenes)]


def _reads_dim(one: Candidate) -> bool:
    return float(one.described.record["settings"].get("darkest_ms", REFERENCE_MS)) < REFERENCE_MS


def _taught(scene: RasterScene, name: str, law: str, files: Sequence[Candidate]) -> bool:
    return any(one.trained_on(scene, name, law) or one.validated_on(name, law) for one in files)


def _light_rows(
    what: str, bright: Sequence[Weights], dim: Sequence[Weights], scenes: Sequence[RasterScene]
) -> Iterator[Row]:
    """Everything read by both kinds of weights, then what seats bring, at every light."""
    first: tuple[Judged, Judged] | None = None
    for name, light in LIGHTS.items():
        theirs, ours = _judged(bright, scenes, light, seats=False)[ALL], _judged(dim, scenes, light)
        pair = theirs, ours[ALL]
        first = first or pair
        for trained, one, before in zip(("full light", "--darkest-ms"), pair, first, strict=True):
            beside = f"{one.beside(before)} beside light 1"
            yield Row(f"{what}, light {name}, all, trained with {trained}", one.words, peers=beside)
        yield Row(f"light {name}, all, --darkest-ms beside full light", ours[ALL].beside(theirs))
        for kind, one in ours.items():
            if kind != ALL:
                gained = "" if kind == NONE else f"{one.beside(ours[NONE])} beside none, "
                yield Row(f"light {name}, {kind}", one.words, peers=f"{gained}{one.beside(ours[ALL])} beside all")
        for share in SHARES:
            drawn = ours[_kind(share, "random")]
            for policy in ("gain", "entropy"):
                chosen = ours[_kind(share, policy)]
                yield Row(f"light {name}, {share:.0%} by {policy} beside random", chosen.beside(drawn))


def _judged(
    arm: Sequence[Weights], scenes: Sequence[RasterScene], light: float, *, seats: bool = True
) -> dict[str, Judged]:
    """Maps of every kind by all weights of an arm, everything read alone without ``seats``."""
    camera, found, of = replace(CAMERA, exposure_ms=light * REFERENCE_MS), dict[str, list[Counts]](), []
    for number, weights in enumerate(arm):
        frames: list[dict[str, Counts]] = []
        for scene in scenes:
            look = look_at(scene, scene.name, weights, camera, number)
            frames.append({kind: np.stack(runs) for kind, runs in _maps(weights, look, seats=seats).items()})
        of.append(number)
        for kind in frames[0]:
            found.setdefault(kind, []).append(np.stack([frame[kind] for frame in frames], axis=1))
    return {
        kind: Judged(np.concatenate(parts), np.repeat(of, [len(part) for part in parts]))
        for kind, parts in found.items()
    }


def _maps(weights: Weights, look: Look, *, seats: bool) -> Mapping[str, list[Counts]]:
    """Confusion counts of every kind of map of one look, one for each random draw."""
    valid = look.seen.grid.valid_seats()

    def counts(own: NDArray[np.integer]) -> Counts:
        drawn = segment(weights, look.seen, look.fine[own], own).classes
        return confusion(look.labels, drawn, weights.config.classes)

    found = {ALL: [counts(valid)]}
    if not seats:
        return found
    there = look.seen.grid.valid_share().ravel() > 0
    found[NONE] = [counts(valid[:0])]
    for share in SHARES:
        for policy, draws in (("gain", 1), ("entropy", 1), ("random", RANDOM_DRAWS)):
            placed = [frame_seats(score_seats(policy, look.seen, seed=draw), share, there) for draw in range(draws)]
            found[_kind(share, policy)] = [counts(one.seats) for one in placed]
    return found


def _kind(share: float, policy: str) -> str:
    return f"{share:.0%} by {policy}"


def _scan_rows(law: str, weights: Weights, scenes: Sequence[RasterScene]) -> Iterator[Row]:
    """The scan that surveys of some seconds choose, beside the best of all that were tried within them."""
    scans = ExposedScans(weights, scenes)
    tried = [(step, exposure_ms) for step in STEPS for exposure_ms in EXPOSURES_MS]
    plain = {
        scan: Judged(scans.counts(*scan)[None], np.zeros(1, np.intp)) for scan in scans.within(tried, max(SECONDS))
    }
    for scan, found in plain.items():
        yield Row(f"{law}, {scan_words(*scan)}", f"{scans.seconds(*scan):.1f} s: {found.words}")
    shortfalls = []
    for seconds in SECONDS:
        chosen = scans.chosen(seconds)
        ours = Judged(scans.counts(chosen.step, chosen.exposure_ms)[None], np.zeros(1, np.intp))
        affordable = {scan: plain[scan] for scan in scans.within(tried, seconds)}
        best = max(affordable, key=lambda scan: affordable[scan].each)
        shortfalls.append(affordable[best].each[0] - ours.each[0])
        said = f"{chosen.seconds:.1f} s: {ours.words}"
        goal = f">= {affordable[best].words} less {SLACK:g}, {scan_words(*best)}"
        promised = f"expected {100 * chosen.expected[MIOU]:.1f}; {ours.beside(affordable[best])} beside the best"
        yield Row(f"{law}, --seconds {seconds:g}: {chosen.words}", said, goal, bool(shortfalls[-1] <= SLACK), promised)
    yield Row(f"{law}, worst shortfall of these", f"{max(shortfalls):.1f} points", f"<= {SLACK:g}")


def _points(difference: float, low: float, high: float) -> str:
    return f"{difference:+.1f} [{low:.1f}, {high:.1f}]"


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Real scenes with light taken away.")
    parser.add_argument("weights", type=Path, nargs="*", metavar="FILE", help="pairs of both kinds, several are seeds")
    for row in rows(parser.parse_args(arguments).weights):
        met = {True: "met", False: "NOT met", None: ""}[row.met]
        print("  ".join(text for text in (row.what, row.figure, row.goal, met, row.peers) if text), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
