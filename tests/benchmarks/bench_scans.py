"""Tables of the shipped weights by law of built-in scenes, measured again on its validation scenes.

`python tests/benchmarks/bench_scans.py [--readings] LAW ...` measures tables, and writes them into the shipped weights:
scan performance, and the fraction of patches that the full network reads. With ``--readings`` the latter alone.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Row

from spectralzoom.flows.training.data import open_training_data
from spectralzoom.flows.training.figures import judge_scans
from spectralzoom.flows.training.train_scenes import CAMERA
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import LEAST_GAINS
from spectralzoom.models.policies.policies import score_patches
from spectralzoom.models.reading.inference import coarse_prediction_of_columns
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation
from spectralzoom.models.training.examples import Example, normalised, observe_scene
from spectralzoom.models.weights.checksummed_files import read_tensors, write_checksummed
from spectralzoom.models.weights.files import BY_LAW, CASCADE, SCANS, Weights, describe_weights, load_weights
from spectralzoom.pipeline.geometry.grid import SceneGrid

SHIPPED = ROOT / "models" / "shipped" / "farm.safetensors"
SCENES = 6
SEED = 4  # of the training
SHORTEST_MS = 3.0
LAWS = ("farm@2", "scouting@1", "trial@1")
WITHIN = 0.5  # points
USUAL_MS = 12.0  # of the scans that surveys choose
AT = 15  # of `LEAST_GAINS`: near that of the usual loss
READINGS = "--readings"


def examples_of(law: str, weights: Weights) -> list[tuple[Example, np.random.Generator]]:
    """Return the validation scenes of a law, each with the stream that captured it."""
    data = open_training_data(law, SCENES, 0, CAMERA)
    reached = np.ones(len(weights.normalisation.centre), np.bool_)
    examples = []
    for number, name in enumerate(data.validation):
        scene, rng = data.scene(name), np.random.default_rng([SEED, 0x0B6, number])
        grid = SceneGrid(*scene.shape, weights.config.patch)
        example = observe_scene(scene, CAMERA, grid, weights.basis, rng, captured=True)
        examples.append((normalised(example, weights.normalisation, reached), rng))
    return examples


def measured(law: str, weights: Weights, examples: Sequence[Example]) -> dict[str, Any]:
    """Return the scan performance table of a law."""

    def report(what: str, done: float, figure: str) -> None:
        print(law, f"{done:.0%}", figure, file=sys.stderr, flush=True)

    augmentation = CaptureAugmentation(weights.normalisation, min_exposure_ms=SHORTEST_MS)
    judged = judge_scans(weights, examples, [law] * len(examples), augmentation, SEED, report)
    assert judged is not None
    return judged[0]


def readings(weights: Weights, examples: Sequence[tuple[Example, np.random.Generator]]) -> dict[str, list[float]]:
    """Return the patches of scenes that each least gain reads, of every line at `USUAL_MS`: median, fewest, most."""
    augmentation = CaptureAugmentation(weights.normalisation, min_exposure_ms=SHORTEST_MS)
    usual = LineSpec(USUAL_MS / REFERENCE_MS, 1)
    found = []
    for example, rng in examples:
        assert example.noise is not None
        columns = augmentation.scanned(
            example.columns, example.noise, light=usual.light, step=1, rng=rng, device=weights.segmenter.device
        )
        grid = SceneGrid(*example.shape, weights.config.patch)
        gain = score_patches("gain", coarse_prediction_of_columns(weights, columns, grid, usual))
        found.append([float((gain >= least).mean()) for least in LEAST_GAINS])
    ends = {"fraction": np.median(found, axis=0), "fewest": np.min(found, axis=0), "most": np.max(found, axis=0)}
    return {name: one.round(4).tolist() for name, one in ends.items()}


def write(parts: dict[str, dict[str, Any]], path: Path = SHIPPED) -> None:
    """Write parts by law, `SCANS` and `CASCADE`, into the record of weights; other scenes get the range of all laws."""
    about = dict(describe_weights(path).about)
    record = about["record"] = dict(about["record"])
    for name, tables in parts.items():
        record[name] = {**record[name], BY_LAW: {**record[name].get(BY_LAW, {}), **tables}}
    every = record[CASCADE].get(BY_LAW, {}).values()
    if every:
        ends = {
            "fewest": np.min([one["fewest"] for one in every], 0),
            "most": np.max([one["most"] for one in every], 0),
        }
        record[CASCADE] |= {name: one.tolist() for name, one in ends.items()}
    write_checksummed(path, about, read_tensors(path, about, lambda name: True))


def rows() -> list[Row]:
    """Return the score of each step at 12 ms, the patches read, and the greatest differences from the record."""
    weights = load_weights(SHIPPED)
    known, read = (weights.record[part][BY_LAW] for part in (SCANS, CASCADE))
    found = []
    for law in LAWS:
        examples = examples_of(law, weights)
        part = readings(weights, examples)
        ends = [f"{100 * part[name][AT]:.0f}" for name in ("fewest", "fraction", "most")]
        found.append(Row(f"{law}: patches of gain {LEAST_GAINS[AT]:g}: fewest, median, most [%]", ", ".join(ends)))
        apart = float(np.abs(np.array(part["fraction"]) - read[law]["fraction"]).max())
        found.append(Row(f"{law}: difference from the record", f"{apart:.4f}", "0.01", apart <= 0.01))
        table = measured(law, weights, [one for one, _ in examples])
        miou, recorded = (100 * np.array(one["miou"]) for one in (table, known[law]))
        at = table["exposures_ms"].index(12.0)
        scores = ", ".join(f"{one:.1f}" for one in miou[:, at])
        off = float(np.abs(miou - recorded).max())
        found.append(Row(f"{law}: steps {table['steps']}, 12 ms", scores))
        found.append(Row(f"{law}: difference from the record", f"{off:.2f}", f"{WITHIN} points", off <= WITHIN))
    return found


if __name__ == "__main__":
    shipped = load_weights(SHIPPED)
    parts: dict[str, dict[str, Any]] = {CASCADE: {}, SCANS: {}}
    for name in [one for one in sys.argv[1:] if one != READINGS]:
        scenes = examples_of(name, shipped)
        parts[CASCADE][name] = readings(shipped, scenes)
        if READINGS not in sys.argv:
            parts[SCANS][name] = measured(name, shipped, [one for one, _ in scenes])
    write(parts)
