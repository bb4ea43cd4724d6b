"""Control networks beside the segmenter on labelled frames: mIoU, its difference to every patch, multiply-adds.

bench_controls.py DATASET --weights FILE --control FILE [--control FILE ...] judges networks that `spectralzoom train
--preset` made on the frames that neither they nor the weights were trained on. Without files there is nothing to judge.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parents[1])]

import numpy as np  # noqa: E402 - after the number of threads is set
from measure import Row  # noqa: E402

from flows.evaluate.frames import Candidate, EvaluateRequest, look_at, open_frames, scene_of, sort_frames  # noqa: E402
from models.evaluation.metrics import confusion, mean_iou, paired_interval  # noqa: E402
from models.network.sizes import control_multiply_adds  # noqa: E402
from models.policies.policies import score_seats  # noqa: E402
from models.reading.control_maps import draw_with_control  # noqa: E402
from models.reading.inference import segment  # noqa: E402
from models.weights.files import load_any_weights, load_weights  # noqa: E402
from pipeline.planning.selection import frame_seats  # noqa: E402

PAPER_SHARE = 0.35  # of the patches that the paper's network reads, by Sobel edges


def rows(dataset: str = "", weights: Path | None = None, controls: Sequence[Path] = ()) -> list[Row]:
    """Judge each control; a row each."""
    if weights is None or not controls:
        return [Row("control networks", "not run: give a data set, --weights and --control")]
    ours, others = load_weights(weights), [load_any_weights(path) for path in controls]
    files = [Candidate.of(path) for path in (weights, *controls)]
    request = EvaluateRequest(dataset, (weights,))
    data = open_frames(dataset, (), None, files[0].camera, {})
    jobs = sort_frames(request, data, files, lambda what, done, words: None)
    names = [name for name, fit in jobs.frames.items() if len(fit) == len(files)]
    every, found, adds = [], [list[np.ndarray]() for _ in others], np.zeros(len(others))
    for name in names:
        scene = scene_of(data, name)
        look = look_at(scene, name, ours, files[0].camera, 0)
        grid, classes = look.seen.grid, ours.config.classes
        valid = grid.valid_seats()
        every.append(confusion(look.labels, segment(ours, look.seen, look.fine[valid], valid).classes, classes))
        for at, network in enumerate(others):
            seats = valid
            if network.config.design == "paper":
                allowed = grid.valid_share().ravel() > 0
                seats = frame_seats(score_seats("sobel", look.seen), PAPER_SHARE, allowed).seats
            drawn = draw_with_control(network, look.seen, look.fine[seats], seats)
            found[at].append(confusion(look.labels, drawn.classes, classes))
            adds[at] += control_multiply_adds(network.config, grid, len(seats), look.bands).total / len(names)
    table = []
    for path, own, each in zip(controls, found, adds, strict=True):
        gap = paired_interval(np.array([own]), np.array([every]))
        told = f"{100 * mean_iou(np.sum(own, axis=0)):.1f} %, {each / 1e6:.0f} million multiply-adds"
        table.append(
            Row(f"{path.stem}, {len(names)} frames", told, peers=f"to every patch {100 * gap.difference:+.1f}")
        )
    return table


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Control networks beside the segmenter.")
    parser.add_argument("dataset")
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--control", type=Path, action="append", required=True)
    asked = parser.parse_args()
    for row in rows(asked.dataset, asked.weights, asked.control):
        print(row.what, row.figure, row.peers, sep="  ")
