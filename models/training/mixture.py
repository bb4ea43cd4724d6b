"""Fit a mixture of classifiers to few labels: candidates by cross-validation, a greedy choice among them, and a prior.

Folds are whole scenes, or blocks as large as the labelled patches: never single pixels, whose neighbours are alike.
"""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.neural_network import MLPClassifier
from torch import Tensor

from spectralzoom.models.evaluation import metrics
from spectralzoom.models.network.mixture import Mixture, Part
from spectralzoom.models.network.segmenter import Segmenter
from spectralzoom.models.network.sizes import AROUND, CONTEXT_WINDOWS, RELATIVE, VALUES, SegmenterConfig
from spectralzoom.models.network.spectral import Normalisation
from spectralzoom.models.training.examples import Example
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.grid import UNLABELLED

HIDDEN = 48  # channels of the network of one layer
COMPONENTS = 20, 10  # of spectra and of relative spectra, at most
FOLDS = 4
MOST_PIXELS = 40_000  # to fit to, of all scenes together
LEAST_PIXELS = 200  # of a class, where it has them: classes are drawn in proportion to their pixels above that
FIRST, ADDED = 3, 12  # candidates that the mixture begins with, and that it may add
LEAST_VARIANCE = 1e-5  # of a component over that of the largest: equal bands differ by rounding alone
LEAST_CHANCE = 1e-3  # of a pixel's own class, in scores: a few wrong labels do not decide
POWERS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the prior
PRIOR_SCENES = 6  # fewer labelled scenes do not tell how frequent a class is
BLOCK_PX = 4, 64  # least and greatest side of the blocks of a fold
NEVER = -1e4  # logit of a class that a part was not taught
Floats = NDArray[np.floating]
Labels = NDArray[np.uint8]
Report = Callable[[str, float, str], None]


@dataclass(frozen=True)
class Candidate:
    """A classifier of one kind of features."""

    name: str
    kind: str
    make: Callable[[], Any]
    hidden: int = 0


def _discriminants() -> Any:
    return LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")


CANDIDATES = (
    *(Candidate(f"{kind}, LDA", kind, _discriminants) for kind in (VALUES, RELATIVE, AROUND)),
    *(
        Candidate(f"{kind}, LR {weight:g}", kind, partial(LogisticRegression, C=weight, max_iter=300))
        for kind, weights in {VALUES: (0.3, 10.0), RELATIVE: (0.3, 10.0), AROUND: (0.1,)}.items()
        for weight in weights
    ),
    Candidate(
        f"{AROUND}, MLP",
        AROUND,
        partial(MLPClassifier, HIDDEN, alpha=0.03, batch_size=128, max_iter=40, random_state=0),
        HIDDEN,
    ),
)


CONTEXT = Candidate("mixture in context", "context", lambda: LogisticRegression(C=0.1, max_iter=300))


@dataclass(frozen=True)
class Taught:
    """Labelled pixels: their features of each kind, classes and folds."""

    features: Mapping[str, NDArray[np.float32]]  # (pixel, feature)
    labels: Labels  # (pixel,)
    fold: NDArray[np.int64]  # (pixel,)
    place: NDArray[np.int64]  # (pixel, 2) number of the example, and of its pixel
    scenes: int  # with a label


@dataclass(frozen=True)
class Judged:
    """A candidate or mixture by cross-validation."""

    name: str
    miou: float
    accuracy: float
    seconds: float  # of a processor
    weight: float = 0.0  # in the mixture


@dataclass(frozen=True)
class Mixed:
    """A segmenter of pixels alone, without a network."""

    segmenter: Segmenter
    plain: int  # number of the part that is the best classifier of single spectra
    judged: tuple[Judged, ...]  # every candidate, and last the mixture


@dataclass(frozen=True)
class Fit:
    """A fitted classifier and the standardisation of its features."""

    fitted: Any
    middle: Floats
    spread: Floats

    @classmethod
    def of(cls, candidate: Candidate, features: Floats, labels: Labels) -> Fit:
        """Fit a candidate to (pixel, feature) values."""
        middle, spread = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
        model = candidate.make()
        weighted = {"sample_weight": pixel_weights(labels)} if isinstance(model, LogisticRegression) else {}
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # not converged; a class of one pixel
            return cls(model.fit((features - middle) / spread, labels, **weighted), middle, spread)

    def predict(self, features: Floats, classes: int) -> Floats:
        """Return probabilities (pixel, class)."""
        found = np.zeros((len(features), classes))
        found[:, self.fitted.classes_.astype(int)] = self.fitted.predict_proba((features - self.middle) / self.spread)
        return found

    def store(self, part: Part, classes: int) -> None:
        """Write the classifier into a part, the standardisation into its first layer."""
        known = self.fitted.classes_.astype(int)
        if part.last is None:
            slope, offset = _of_classes(self.fitted.coef_, self.fitted.intercept_, known, classes)
        else:
            slope, offset = self.fitted.coefs_[0].T, self.fitted.intercepts_[0]
            last = _of_classes(self.fitted.coefs_[1].T, self.fitted.intercepts_[1], known, classes)
            _write(part.last, *last)
        _write(part.first, slope / self.spread, offset - slope @ (self.middle / self.spread))


def pixel_weights(labels: Labels) -> Floats:
    """Return the weight of each pixel, 1 in the mean: a class counts by the root of its number of pixels.

    mIoU counts each class once. Equal weights of pixels would lose small classes. Equal weights of classes would leave
    the choice to a few pixels.
    """
    weights: Floats = 1 / np.sqrt(np.maximum(np.bincount(labels), 1))[labels]
    weights /= weights.mean()
    return weights


def _of_classes(slope: Floats, offset: Floats, known: NDArray[np.intp], classes: int) -> tuple[Floats, Floats]:
    """Return the layer of every class; scikit-learn has one function for two classes, and none for others."""
    if len(known) == 2 and len(slope) == 1:
        slope, offset = np.concatenate([0 * slope, slope]), np.concatenate([0 * offset, offset])
    weight, bias = np.zeros((classes, slope.shape[1])), np.full(classes, NEVER)
    weight[known], bias[known] = slope, offset
    return weight, bias


def _write(layer: torch.nn.Linear, weight: Floats, bias: Floats) -> None:
    with torch.no_grad():
        layer.weight.copy_(torch.from_numpy(np.asarray(weight, np.float32)))
        layer.bias.copy_(torch.from_numpy(np.asarray(bias, np.float32)))


def fit_mixture(
    examples: Sequence[Example], normalisation: Normalisation, config: SegmenterConfig, seed: int, report: Report
) -> Mixed:
    """Return a segmenter of pixels alone, fitted to normalised scenes.

    Raises SceneError: there are as few labelled pixels as classes.
    """
    rng = np.random.default_rng([seed, 0x31])
    columns = config.columns
    components = min(COMPONENTS[0], columns), min(COMPONENTS[1], columns + 1)
    measured = Mixture(replace(config, parts=((VALUES, 0, 1.0),), components=components))
    _measure(measured, examples, normalisation)
    began = time.process_time()
    taught = taught_pixels(measured, examples, rng)
    known = np.unique(taught.labels)
    if len(known) >= len(taught.labels):
        raise SceneError(
            f"{len(taught.labels)} labelled pixels of {len(known)} classes are too few; label more of each"
        )
    apart = _apart(taught, config.classes, report)
    weights, mixed = _chosen(apart, taught)
    plain = max((one for one in CANDIDATES if one.kind == VALUES), key=lambda one: apart[one.name][1].miou)
    parts = [one for one in CANDIDATES if one.name in weights or one is plain]
    segmenter = _fitted(config, measured, parts, weights, taught)
    own = _judged("mixture", mixed, taught.labels, config.classes, time.process_time() - began)
    began = time.process_time()
    if (context := _in_context(segmenter.mixture, parts, taught, examples)) is not None:
        found = _judged(CONTEXT.name, context[1], taught.labels, config.classes, time.process_time() - began)
        if _likelihood(context[1], taught.labels) > _likelihood(mixed, taught.labels):
            mixed, tensors, own = context[1], segmenter.state_dict(), found
            segmenter = Segmenter(replace(segmenter.config, context=True)).eval()
            segmenter.load_state_dict(tensors, strict=False)
            context[0].store(segmenter.mixture.context, config.classes)
    power = _prior_power(mixed, taught, config.classes)
    fraction = np.bincount(taught.labels, minlength=config.classes) / len(taught.labels)
    prior = np.where(fraction > 0, -power * np.log(np.maximum(fraction, 1e-12)), 0)
    with torch.no_grad():
        segmenter.mixture.prior.copy_(torch.from_numpy(prior.astype(np.float32)))
    shown = [replace(judged, weight=weights.get(name, 0.0)) for name, (_, judged) in apart.items()]
    return Mixed(segmenter, parts.index(plain), (*shown, own))


def _fitted(
    config: SegmenterConfig, measured: Mixture, parts: Sequence[Candidate], weights: Mapping[str, float], taught: Taught
) -> Segmenter:
    """Fit the parts of a mixture to all pixels, on the components that were ``measured``."""
    sizes = tuple((one.kind, one.hidden, weights.get(one.name, 0.0)) for one in parts)
    own = replace(config, parts=sizes, components=measured.config.components, corrected=False)
    segmenter = Segmenter(own).eval()
    same = {name: one for name, one in measured.state_dict().items() if not name.startswith("parts")}
    segmenter.mixture.load_state_dict(same, strict=False)
    for part, one in zip(segmenter.mixture.each_part, parts, strict=True):
        Fit.of(one, taught.features[one.kind], taught.labels).store(part, config.classes)
    return segmenter


def _measure(mixture: Mixture, examples: Sequence[Example], normalisation: Normalisation) -> None:
    """Set the scale of scene values and the whitened components, by every third pixel of every third row."""
    values = np.linalg.inv(normalisation.whitening.astype(np.float64)) * normalisation.spread
    sample = np.concatenate([one.columns[::3, ::3].reshape(-1, one.columns.shape[-1]) for one in examples])
    sample = np.asarray(sample[np.isfinite(sample).all(axis=1)], np.float32)
    with torch.no_grad():
        mixture.to_values.copy_(torch.from_numpy(values.astype(np.float32)))
        mixture.centre.copy_(torch.from_numpy(normalisation.centre))
        mixture.own_axes.copy_(_whitened(sample, mixture.own_axes.shape[1])[0])
        axes, middle = _whitened(mixture.relative(torch.from_numpy(sample)).numpy(), mixture.relative_axes.shape[1])
        mixture.relative_axes.copy_(axes)
        mixture.relative_centre.copy_(middle)


def _whitened(sample: Floats, count: int) -> tuple[Tensor, Tensor]:
    """Return axes (feature, component) of variance 1, the largest first, and the mean; 0 for directions of rounding."""
    exact = sample.astype(np.float64)
    power, axes = np.linalg.eigh(np.atleast_2d(np.cov(exact.T)))
    power, axes = power[::-1][:count], axes[:, ::-1][:, :count]
    there = power > LEAST_VARIANCE * max(float(power[0]), 1e-12)
    scaled = np.where(there, axes / np.sqrt(np.where(there, power, 1)), 0)
    return torch.from_numpy(scaled.astype(np.float32)), torch.from_numpy(exact.mean(axis=0).astype(np.float32))


def taught_pixels(mixture: Mixture, examples: Sequence[Example], rng: np.random.Generator) -> Taught:
    """Return labelled pixels of all scenes, `MOST_PIXELS` or so, in proportion; rare classes have more."""
    counts = np.sum([np.bincount(one.labels.ravel(), minlength=256)[:UNLABELLED] for one in examples], axis=0)
    fraction = np.minimum(1.0, np.maximum(MOST_PIXELS / counts.sum(), LEAST_PIXELS / np.maximum(counts, 1)))
    features: dict[str, list[Floats]] = {kind: [] for kind in (VALUES, RELATIVE, AROUND)}
    labels, folds, found = [], [], []
    for number, (example, fold) in enumerate(
        zip(examples, folds_of([one.labels for one in examples], rng), strict=True)
    ):
        chance = np.append(fraction, np.zeros(256 - len(fraction)))[example.labels.ravel()]
        places = np.flatnonzero(rng.random(len(chance)) < chance)
        if not len(places):
            continue
        with torch.inference_mode():
            image = torch.from_numpy(np.asarray(example.columns, np.float32)).movedim(-1, 0)[None]
            for kind, own in mixture.of_pixels(image, features, torch.from_numpy(places)).items():
                features[kind].append(own.numpy())
        labels.append(example.labels.ravel()[places])
        folds.append(fold.ravel()[places])
        found.append(np.stack([np.full_like(places, number), places], axis=1))
    joined = {kind: np.concatenate(parts) for kind, parts in features.items()}
    return Taught(joined, np.concatenate(labels), np.concatenate(folds), np.concatenate(found), len(labels))


def folds_of(labels: Sequence[Labels], rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Return the fold of each pixel (y, x) of each scene: whole scenes if there are enough, else labelled patches."""
    if len(labels) >= FOLDS:
        order = rng.permutation(len(labels))
        return [np.full(one.shape, order[number] % FOLDS) for number, one in enumerate(labels)]
    return [_patch_folds(one, rng) for one in labels]


def _patch_folds(labels: Labels, rng: np.random.Generator) -> NDArray[np.int64]:
    """Deal the labelled patches of each class to the folds, large ones first; larger ones than usual are cut."""
    patch, top = np.zeros(labels.shape, np.int64), 0
    classes = [int(one) for one in np.unique(labels) if one != UNLABELLED]
    for one in classes:
        own, count = scipy.ndimage.label(labels == one)
        patch[own > 0] = own[own > 0] + top
        top += count
    sizes = np.bincount(patch.ravel(), minlength=top + 1)
    side = int(np.clip(np.sqrt(np.median(sizes[1:])), *BLOCK_PX)) if top else 1
    y, x = np.indices(labels.shape) // side
    cut = (sizes > 4 * side**2)[patch]
    patch = np.where(cut, top + 1 + y * labels.shape[1] + x, patch)
    fold = np.zeros(labels.shape, np.int64)
    for one in classes:
        numbers, counts = np.unique(patch[labels == one], return_counts=True)
        load = np.zeros(FOLDS)
        dealt = np.empty(len(numbers), np.int64)
        for at in np.lexsort((rng.random(len(numbers)), -counts)):
            dealt[at] = np.argmin(load + rng.random(FOLDS))
            load[dealt[at]] += counts[at]
        mine = labels == one
        fold[mine] = dealt[np.searchsorted(numbers, patch[mine])]
    return fold


def _apart(taught: Taught, classes: int, report: Report) -> dict[str, tuple[Floats, Judged]]:
    """Return the probabilities (pixel, class) of each candidate for the pixels that it was not fitted to."""
    found: dict[str, tuple[Floats, Judged]] = {}
    for number, one in enumerate(CANDIDATES):
        began = time.process_time()
        features = taught.features[one.kind]
        probability = np.full((len(taught.labels), classes), 1 / classes)
        for fold in range(FOLDS):
            learn, judge = taught.fold != fold, taught.fold == fold
            if judge.any() and 1 < len(np.unique(taught.labels[learn])) < np.count_nonzero(learn):
                fit = Fit.of(one, features[learn], taught.labels[learn])
                probability[judge] = fit.predict(features[judge], classes)
        judged = _judged(one.name, probability, taught.labels, classes, time.process_time() - began)
        found[one.name] = probability, judged
        report("cross-validating", (number + 1) / len(CANDIDATES), f"{one.name}: {100 * judged.miou:.1f}")
    return found


def _judged(name: str, probability: Floats, labels: Labels, classes: int, seconds: float) -> Judged:
    counts = metrics.confusion(labels, probability.argmax(axis=1).astype(np.uint8), classes)
    return Judged(name, metrics.mean_iou(counts), metrics.overall_accuracy(counts), seconds)


def _in_context(
    mixture: Mixture, parts: Sequence[Candidate], taught: Taught, examples: Sequence[Example]
) -> tuple[Fit, Floats] | None:
    """Fit a classifier of the mixture's probabilities around a pixel; return it and its probabilities (pixel, class).

    Both the probabilities that it learns from and its own are those of scenes that were not fitted to. None where folds
    are no whole scenes, or surroundings do not count.
    """
    around = any(kind == AROUND and weight for kind, _, weight in mixture.config.parts)
    folds = [taught.fold != fold for fold in range(FOLDS)]
    if not around or len(examples) < FOLDS or any(len(np.unique(taught.labels[learn])) < 2 for learn in folds):
        return None
    classes = mixture.config.classes
    features = np.zeros((len(taught.labels), len(CONTEXT_WINDOWS) * classes), np.float32)
    own = copy.deepcopy(mixture)
    for learn in folds:
        for part, one in zip(own.each_part, parts, strict=True):
            Fit.of(one, taught.features[one.kind][learn], taught.labels[learn]).store(part, classes)
        for number in np.unique(taught.place[~learn, 0]):
            here = taught.place[:, 0] == number
            image = torch.from_numpy(np.asarray(examples[number].columns, np.float32)).movedim(-1, 0)[None]
            with torch.inference_mode():
                every = own.surrounding(own.mixed(image)).flatten(0, 2)
                features[here] = every[torch.from_numpy(taught.place[here, 1])].numpy()
    probability = np.full((len(taught.labels), classes), 1 / classes)
    for learn in folds:
        if not learn.all():
            fit = Fit.of(CONTEXT, features[learn], taught.labels[learn])
            probability[~learn] = fit.predict(features[~learn], classes)
    return Fit.of(CONTEXT, features, taught.labels), probability


def _likelihood(total: Floats, labels: Labels) -> float:
    """Return the weighted mean logarithm of the probability of a pixel's own class, of (pixel, class) in proportion."""
    of_labels = total[np.arange(len(total)), labels] / total.sum(axis=1)
    return float((pixel_weights(labels) * np.log(np.maximum(of_labels, LEAST_CHANCE))).mean())


def _chosen(apart: Mapping[str, tuple[Floats, Judged]], taught: Taught) -> tuple[dict[str, float], Floats]:
    """Return the weights of candidates in the mixture, and its probabilities (Caruana et al. 2004).

    The score is the mean logarithm of the probability of a pixel's own class: of 16 classes most are missing in a fold,
    where mIoU misled by 5 points.
    """
    score = partial(_likelihood, labels=taught.labels)
    scores = {name: score(one) for name, (one, _) in apart.items()}
    around = {one.name for one in CANDIDATES if one.kind == AROUND}
    best = max(scores[name] for name in scores if name not in around)
    if taught.scenes > 1 and max(scores[name] for name in around) <= best:
        scores = {name: one for name, one in scores.items() if name not in around}
    weights = dict.fromkeys(sorted(scores, key=lambda name: -scores[name])[:FIRST], 1)
    total = np.sum([apart[name][0] for name in weights], axis=0)
    for _ in range(ADDED):
        name = max(scores, key=lambda one: score(total + apart[one][0]))
        if score(total + apart[name][0]) <= score(total):
            break
        weights[name] = weights.get(name, 0) + 1
        total = total + apart[name][0]
    times = sum(weights.values())
    return {name: often / times for name, often in weights.items()}, total / times


def _prior_power(mixed: Floats, taught: Taught, classes: int) -> float:
    """Return the power of the classes' fractions that probabilities are divided by."""
    if taught.scenes < PRIOR_SCENES:
        return 0.0
    fraction = np.maximum(np.bincount(taught.labels, minlength=classes) / len(taught.labels), 1e-12)
    return max(POWERS, key=lambda power: _judged("", mixed / fraction**power, taught.labels, classes, 0.0).miou)
