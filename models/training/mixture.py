"""Fit a mixture of classifiers to labelled pixels: candidates, folds, a greedy choice by cross-validation, and a prior."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.neural_network import MLPClassifier

from spectralzoom.models.evaluation import metrics
from spectralzoom.models.network.mixture import CTX, PX, PXN, Mixture, MixtureConfig
from spectralzoom.pipeline.geometry.grid import UNLABELLED

OWN, SHAPE = 20, 10  # components of ctx at most
FOLDS = 4
MOST_PIXELS = 40_000  # to fit a candidate to
FIRST, ADDED = 3, 12
PRIORS = (0.0, 0.25, 0.5, 0.75, 1.0)
PRIOR_SCENES = 6  # with fewer labelled scenes the classes' fractions are not known
Floats = NDArray[np.floating]
Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Candidate:
    """A classifier of one kind of features."""

    name: str
    kind: str
    make: Callable[[], Any]
    hidden: int = 0


def _lda() -> Any:
    return LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")


def candidates(*, around: bool) -> list[Candidate]:
    found = []
    for kind in (PX, PXN):
        found += [Candidate(f"{kind} LDA", kind, _lda)]
        found += [Candidate(f"{kind} LR {c:g}", kind, lambda c=c: LogisticRegression(C=c, max_iter=300)) for c in (0.3, 10.0)]
    if around:
        found += [
            Candidate("ctx LDA", CTX, _lda),
            Candidate("ctx LR", CTX, lambda: LogisticRegression(C=0.1, max_iter=200)),
            Candidate("ctx MLP", CTX, lambda: MLPClassifier(48, alpha=3e-2, max_iter=40, early_stopping=False, batch_size=128, random_state=0), 48),
        ]
    return found


@dataclass(frozen=True)
class Taught:
    """Labelled pixels: features by kind (pixel, feature), classes, and the fold of each."""

    features: dict[str, NDArray[np.float32]]
    labels: Labels
    fold: NDArray[np.int64]
    scenes: int
    classes: int


@dataclass
class Fitted:
    mixture: Mixture
    scores: dict[str, float]
    chosen: dict[str, int]
    mixed: float
    prior: float
    seconds: dict[str, float] = field(default_factory=dict)
    out_of_fold: Any = None


def score_of(probability: Floats, labels: Labels, classes: int) -> float:
    counts = metrics.confusion(labels, probability.argmax(axis=1).astype(np.uint8), classes)
    return metrics.mean_iou(counts) + metrics.overall_accuracy(counts)


def folds_of(labels: Sequence[Labels], rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Return the fold of each pixel (y, x): whole scenes, or blocks as large as the labelled patches."""
    if len(labels) >= FOLDS:
        order = rng.permutation(len(labels))
        return [np.full(one.shape, int(np.flatnonzero(order == n)[0]) % FOLDS) for n, one in enumerate(labels)]
    from scipy.ndimage import label as components

    found = []
    for one in labels:
        fold = np.zeros(one.shape, np.int64)
        known = one != UNLABELLED
        marks = np.zeros(one.shape, np.int64)
        top = 0
        for c in np.unique(one[known]):  # patches of one class
            own, count = components(one == c)
            marks[own > 0] = own[own > 0] + top
            top += count
        sizes = np.bincount(marks.ravel())[1:]
        side = int(np.clip(np.sqrt(np.median(sizes)) if len(sizes) else 1, 4, 64))
        big = sizes > 4 * side * side
        y, x = np.indices(one.shape)
        block = (y // side) * 10_000 + x // side
        group = np.where(big[np.maximum(marks - 1, 0)] if len(sizes) else False, block + 10**9, marks)
        # groups of each class are dealt to the folds in turn, the largest first
        for c in np.unique(one[known]):
            ids, count = np.unique(group[one == c], return_counts=True)
            load = np.zeros(FOLDS)
            for k in np.lexsort((rng.random(len(ids)), -count)):
                f = int(np.argmin(load + rng.random(FOLDS) * 1e-6))
                load[f] += count[k]
                fold[(group == ids[k]) & (one == c)] = f
        found.append(fold)
    return found


def basis_of(mixture: Mixture, columns: Sequence[Floats], to_values: Floats, centre: Floats) -> None:
    """Set the components of ctx from the pixels of all scenes."""
    with torch.no_grad():
        mixture.to_values.copy_(torch.from_numpy(np.asarray(to_values, np.float32)))
        mixture.centre.copy_(torch.from_numpy(np.asarray(centre, np.float32)))
        sample = np.concatenate([one[::3, ::3].reshape(-1, one.shape[-1]) for one in columns]).astype(np.float32)
        sample = sample[np.isfinite(sample).all(axis=1)]
        tensor = torch.from_numpy(sample)
        mixture.own_axes.copy_(_whitened(sample, mixture.config.own)[0])
        relative = mixture.relative(tensor).numpy()
        axes, middle = _whitened(relative, mixture.config.shape)
        mixture.shape_axes.copy_(axes)
        mixture.shape_centre.copy_(middle)


def _whitened(sample: Floats, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    exact = sample.astype(np.float64)
    middle = exact.mean(axis=0)
    power, axes = np.linalg.eigh(np.cov(exact.T))
    power, axes = power[::-1][:count], axes[:, ::-1][:, :count]
    return torch.from_numpy((axes / np.sqrt(np.maximum(power, 1e-9 * power[0]))).astype(np.float32)), torch.from_numpy(middle.astype(np.float32))


def teach(mixture: Mixture, columns: Sequence[Floats], labels: Sequence[Labels], rng: np.random.Generator, *, around: bool) -> Taught:
    """Return the features of labelled pixels, `MOST_PIXELS` at most, from each class of each scene alike."""
    folds = folds_of(labels, rng)
    kinds = (PX, PXN, CTX) if around else (PX, PXN)
    total = sum(int((one != UNLABELLED).sum()) for one in labels)
    made: dict[str, list[Floats]] = {kind: [] for kind in kinds}
    marks, fold = [], []
    for one, own, part in zip(columns, labels, folds, strict=True):
        places = np.flatnonzero(own != UNLABELLED)
        if total > MOST_PIXELS:
            places = np.sort(rng.choice(places, int(len(places) * MOST_PIXELS / total), replace=False))
        if not len(places):
            continue
        with torch.inference_mode():
            image = torch.from_numpy(np.asarray(one, np.float32)).movedim(-1, 0)[None]
            for kind, every in mixture.features(image, kinds).items():
                made[kind].append(every.reshape(-1, every.shape[-1])[torch.from_numpy(places)].numpy())
        marks.append(own.ravel()[places])
        fold.append(part.ravel()[places])
    return Taught({kind: np.concatenate(parts) for kind, parts in made.items()}, np.concatenate(marks), np.concatenate(fold), len(marks), mixture.classes)


def _fit(candidate: Candidate, features: Floats, labels: Labels) -> tuple[Any, Floats, Floats]:
    middle, spread = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    with warnings.catch_warnings(action="ignore"):
        fitted = candidate.make().fit((features - middle) / spread, labels)
    return fitted, middle, spread


def _predicted(fit: tuple[Any, Floats, Floats], features: Floats, classes: int) -> NDArray[np.float64]:
    fitted, middle, spread = fit
    found = np.zeros((len(features), classes))
    found[:, fitted.classes_.astype(int)] = fitted.predict_proba((features - middle) / spread)
    return found


def fit_mixture(mixture_of: Callable[[MixtureConfig], Mixture], taught: Taught, *, around: bool, say=lambda *_: None) -> Fitted:
    every = candidates(around=around)
    known = np.unique(taught.labels)
    out, seconds = {}, {}
    for one in every:
        began = time.process_time()
        found = np.zeros((len(taught.labels), taught.classes))
        for fold in range(FOLDS):
            learn, judge = taught.fold != fold, taught.fold == fold
            if not judge.any() or len(np.unique(taught.labels[learn])) < 2:
                found[judge] = 1 / taught.classes
                continue
            features = taught.features[one.kind]
            found[judge] = _predicted(_fit(one, features[learn], taught.labels[learn]), features[judge], taught.classes)
        out[one.name] = found
        seconds[one.name] = time.process_time() - began
        say(one.name, score_of(found, taught.labels, taught.classes), seconds[one.name])
    scores = {name: score_of(found, taught.labels, taught.classes) for name, found in out.items()}
    usable = list(scores)
    if taught.scenes > 1 and around:
        best = {kind: max((scores[one.name] for one in every if (one.kind == CTX) == (kind == CTX)), default=-1) for kind in (PX, CTX)}
        if best[CTX] <= best[PX]:
            usable = [one.name for one in every if one.kind != CTX]
    chosen = dict.fromkeys(sorted(usable, key=lambda name: -scores[name])[:FIRST], 1)
    total = sum(out[name] for name in chosen)
    for _ in range(ADDED):
        now = score_of(total, taught.labels, taught.classes)
        name, best = max(((name, score_of(total + out[name], taught.labels, taught.classes)) for name in usable), key=lambda pair: pair[1])
        if best <= now:
            break
        chosen[name] = chosen.get(name, 0) + 1
        total = total + out[name]
    mixed = total / sum(chosen.values())
    fraction = np.bincount(taught.labels, minlength=taught.classes) / len(taught.labels)
    power = 0.0
    if taught.scenes >= PRIOR_SCENES:
        power = max(PRIORS, key=lambda a: (score_prior(mixed, fraction, a, taught), -a))
    parts = [one for one in every if one.name in chosen]
    mixture = mixture_of(MixtureConfig(tuple((one.kind, one.hidden) for one in parts), OWN, SHAPE))
    with torch.no_grad():
        for part, one in zip(mixture.parts, parts, strict=True):
            _store(part, _fit(one, taught.features[one.kind], taught.labels), taught.classes)
        mixture.weight.copy_(torch.tensor([chosen[one.name] for one in parts]) / sum(chosen.values()))
        prior = np.full(taught.classes, -np.inf)
        prior[known] = -power * np.log(fraction[known])
        mixture.prior.copy_(torch.from_numpy(prior.astype(np.float32)))
    return Fitted(mixture, scores, chosen, score_of(mixed, taught.labels, taught.classes), power, seconds, mixed)


def score_prior(mixed, fraction, a, taught):
    with np.errstate(divide="ignore"):
        factor = np.where(fraction > 0, np.maximum(fraction, 1e-12) ** -a, 0)
    counts = metrics.confusion(taught.labels, (mixed * factor).argmax(axis=1).astype(np.uint8), taught.classes)
    return metrics.mean_iou(counts)


def _store(part: Any, fit: tuple[Any, Floats, Floats], classes: int) -> None:
    """Write a fitted classifier into a part; standardisation is folded into its first layer."""
    fitted, middle, spread = fit
    known = fitted.classes_.astype(int)
    if hasattr(fitted, "coefs_"):
        slope, offset = fitted.coefs_[0].T, fitted.intercepts_[0]
        last, last_offset = fitted.coefs_[1].T, fitted.intercepts_[1]
        if len(known) == 2 and len(last) == 1:
            last, last_offset = np.concatenate([0 * last, last]), np.concatenate([0 * last_offset, last_offset])
        weight, bias = np.zeros((classes, last.shape[1])), np.full(classes, -1e4)
        weight[known], bias[known] = last, last_offset
        part.last.weight.copy_(torch.from_numpy(weight.astype(np.float32)))
        part.last.bias.copy_(torch.from_numpy(bias.astype(np.float32)))
        whole, start = slope, offset
    else:
        slope, offset = fitted.coef_, fitted.intercept_
        if len(known) == 2 and len(slope) == 1:
            slope, offset = np.concatenate([0 * slope, slope]), np.concatenate([0 * offset, offset])
        whole, start = np.zeros((classes, slope.shape[1])), np.full(classes, -1e4)
        whole[known], start[known] = slope, offset
    part.first.weight.copy_(torch.from_numpy((whole / spread).astype(np.float32)))
    part.first.bias.copy_(torch.from_numpy((start - whole @ (middle / spread)).astype(np.float32)))
