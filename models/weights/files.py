"""Weights on disk: one checksummed file with the tensors, the spectral basis, the classes and how they were made.

The file may also hold what is familiar to the weights and their reader of prior maps: each adds a description and
tensors of its own, and leaves the key of the weights as it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis, check_basis, project
from models.reading.ood import Limits, OodDetector
from models.weights import checksummed_files
from models.weights.checksummed_files import NotChecksummedError, claimed_shapes, key_of, read_about, write_checksummed
from models.weights.parts import OOD, READER, OodPart, ReaderPart, TrainedOn
from pipeline.errors import WeightsError
from pipeline.lazy import deferred
from pipeline.readings import readings_alone
from pipeline.signal.components import Components

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from models.network import segmenter, temporal_reader
    from models.network.segmenter import Segmenter
    from models.network.temporal_reader import TemporalReader
else:
    torch = deferred("torch")
    temporal_reader = deferred("models.network.temporal_reader")
    segmenter = deferred("models.network.segmenter")

NORMALISATION = ("centre", "spread", "whitening")
FORMAT = "spectralzoom-weights/4"
OF_COMPONENTS = ("centres", "covariance", "shot", "read")
OF_LIMITS = ("rates", "light", "fine")
SPREAD = "normalisation.spread"
CASCADE = "cascade"  # of a record: what reading a part of the patches in full loses
CALIBRATION = "calibration"  # of a record: how sure of themselves maps may be, and the temperature, where one is needed
KINDS = {"F32": "torch.float32", "U8": "torch.uint8"}  # by safetensors' names


@dataclass(frozen=True)
class Description:
    """Description of a weights file; reading it takes neither its tensors nor torch."""

    config: SegmenterConfig
    basis: SpectralBasis
    class_names: tuple[str, ...]
    record: dict[str, Any]
    key: str = ""  # names what the weights hold
    ood_detector: OodPart | None = None
    reader: ReaderPart | None = None
    about: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)  # all of it, hashes too


@dataclass(frozen=True)
class Weights:
    """A segmenter with all it needs: basis, normalisation, classes, and the record of its training."""

    segmenter: Segmenter
    basis: SpectralBasis
    normalisation: Normalisation
    class_names: tuple[str, ...]
    class_colours: NDArray[np.uint8]  # (class, 3)
    record: dict[str, Any] = field(default_factory=dict)  # command, seed, data, split, validation

    @property
    def config(self) -> SegmenterConfig:
        """Sizes of the network."""
        return self.segmenter.config

    @property
    def temperature(self) -> float:
        """Divisor of the logits of maps; 1 unless the record of training has another."""
        return float((self.record.get(CALIBRATION) or {}).get("temperature", 1.0))

    def columns(self, values: NDArray[np.floating], wavelength_nm: NDArray[np.floating]) -> NDArray[np.float32]:
        """Normalised spectral columns of pixels, (..., band) -> (..., column) float32.

        Columns that no band reaches take what the others let expect, and so do those of which all bands are dead.
        A value that is no reading by `Normalisation.most_value` is dead. A pixel with more than half of its bands dead
        is NaN.
        """
        values = readings_alone(values, self.normalisation.most_value)
        matrix, reached = self.basis.matrix(wavelength_nm)
        seen = project(values, matrix)
        columns = self.normalisation.apply(seen, reached)
        columns[~np.isfinite(seen[..., reached]).any(axis=-1)] = np.nan
        return columns

    def columns_of_scores(
        self, scores: NDArray[np.floating], components: Components, wavelength_nm: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Normalised spectral columns of pixels given by scores of components, (..., component) -> (..., column).

        They are linear in scores. A column that is no reading by `Normalisation.most_value` is completed as one that no
        band reaches; a pixel without scores is NaN.
        """
        lit = np.isfinite(components.mean)
        matrix = np.zeros((components.bands, self.config.columns), np.float32)
        matrix[lit], reached = self.basis.matrix(np.asarray(wavelength_nm)[lit])
        weights, offset = components.onto(matrix)
        with np.errstate(invalid="ignore", over="ignore"):
            seen = np.asarray(scores, np.float32) @ weights + offset
        seen = readings_alone(seen, self.normalisation.most_value)
        columns = self.normalisation.apply(seen, reached)
        columns[~np.isfinite(seen[..., reached]).any(axis=-1)] = np.nan
        return columns

    def on(self, device: str) -> Weights:
        """The same where it computes on a device of this machine, by `models.network.machine.choose_device`."""
        self.segmenter.to(device)
        return self


def save_weights(weights: Weights, path: Path) -> None:
    """Write the file, checksummed, by a temporary name and a rename, so that it is whole or absent.

    Raises WeightsError where the disk refuses.
    """
    tensors = dict(weights.segmenter.state_dict())
    for name in NORMALISATION:
        tensors[f"normalisation.{name}"] = torch.from_numpy(getattr(weights.normalisation, name).copy())
    tensors["class_colours"] = torch.from_numpy(weights.class_colours.copy())
    about = {
        "config": asdict(weights.config),
        "basis": asdict(weights.basis),
        "class_names": list(weights.class_names),
        "record": weights.record,
    }
    keys = {"weights": key_of(about, tensors)}
    _write(path, {**about, "format": FORMAT, "keys": keys}, tensors)


def _write(path: Path, about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    try:
        write_checksummed(path, about, tensors)
    except OSError as error:
        raise WeightsError(f"cannot write weights to {path}: {error.strerror}; choose another -o") from error


def add_ood(
    weights: Path, out: Path, ood_detector: OodDetector, trained_on: TrainedOn, record: Mapping[str, Any]
) -> None:
    """Write the weights of a file with what is familiar to them to ``out``, which may be the same file.

    Raises WeightsError: the weights cannot be read, or ``out`` not be written.
    """
    limits = ood_detector.limits
    arrays = {name: getattr(ood_detector, name) for name in OF_COMPONENTS}
    arrays |= {name: getattr(limits, name) for name in OF_LIMITS}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(one, np.float32)) for name, one in arrays.items()}
    about = {"bands": ood_detector.bands, "steps": list(limits.steps), "trained_on": trained_on.as_dict()}
    _add_part(weights, out, OOD, {**about, "record": dict(record)}, tensors)


def add_reader(weights: Path, out: Path, reader: TemporalReader, record: Mapping[str, Any]) -> None:
    """Write the weights of a file with their reader of prior maps to ``out``. Raises as `add_ood`."""
    about = {"sizes": asdict(reader.sizes), "record": dict(record)}
    _add_part(weights, out, READER, about, dict(reader.state_dict()))


def _add_part(source: Path, out: Path, part: str, about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    described = describe_weights(source)
    with _told_as(source):
        whole = checksummed_files.read_tensors(source, described.about)
    kept = {name: tensor for name, tensor in whole.items() if not name.startswith(f"{part}.")}
    added = {f"{part}.{name}": tensor for name, tensor in tensors.items()}
    keys = {**described.about["keys"], part: key_of(about, tensors)}
    _write(out, {**described.about, "keys": keys, part: about}, kept | added)


def load_ood(weights: Path) -> OodDetector:
    """Read what is familiar to weights. WeightsError: their file has no such part, or it is damaged."""
    described = describe_weights(weights)
    if described.ood_detector is None:
        raise WeightsError(
            f"{weights} does not say what is familiar to it; measure it with: spectralzoom train DATASET"
            f" --fit-ood {weights} -o {weights}"
        )
    tensors, about = _read_part(weights, described, OOD, spreads=("light", "rates")), described.ood_detector
    try:
        arrays = {name: tensors[name].double().numpy() for name in (*OF_COMPONENTS, *OF_LIMITS)}
        limits = Limits(arrays["rates"], arrays["light"], about.steps, arrays["fine"])
        found = OodDetector(**{name: arrays[name] for name in OF_COMPONENTS}, limits=limits, bands=about.bands)
        found.lit(float(limits.light[0]))  # refuses a covariance that is none
    except (KeyError, ValueError) as error:
        raise WeightsError(f"{weights} is damaged: what is familiar: {error}; copy or measure it again") from error
    return found


def load_reader(weights: Path) -> TemporalReader:
    """Read the reader of prior maps of weights. WeightsError: their file has none, or it is damaged."""
    described = describe_weights(weights)
    if described.reader is None:
        raise WeightsError(
            f"{weights} has no reader of prior maps; train one with: spectralzoom train DATASET --train-temporal "
            f"{weights} -o {weights}"
        )
    tensors = _read_part(weights, described, READER)
    with torch.device("meta"):
        reader = temporal_reader.TemporalReader(described.reader.sizes)
    try:
        reader.load_state_dict(tensors, assign=True)
    except RuntimeError as error:
        why = str(error).splitlines()[-1].strip()
        raise WeightsError(f"{weights} is damaged: its reader of prior maps: {why}; train it again") from error
    return reader.eval()


def _read_part(path: Path, described: Description, part: str, spreads: Sequence[str] = ()) -> dict[str, Tensor]:
    """Tensors of a part by their own names. Raises WeightsError where one is not what was written, or unusable."""
    start = f"{part}."
    with _told_as(path):
        tensors = checksummed_files.read_tensors(path, described.about, lambda name: name.startswith(start))
        own = {name.removeprefix(start): tensor for name, tensor in tensors.items()}
        check_numbers(own, spreads)
    return own


@contextmanager
def _told_as(path: Path) -> Iterator[None]:
    """Raise WeightsError, with what to do, where a file of weights is not what was written."""
    try:
        yield
    except NotChecksummedError as error:
        raise WeightsError(f"{path} {error}; copy or train the file again") from error


def load_weights(path: Path) -> Weights:
    """Read a file that ``save_weights`` wrote. No pickle is involved.

    Raises WeightsError where it is missing or of another format, or where a tensor (named) is not the one that was
    written, does not fit its config, or holds what is no finite number.
    """
    described = describe_weights(path)
    tensors = read_tensors(path, described)
    network = segmenter.Segmenter(described.config)
    network.load_state_dict({name: tensors[name] for name in network.state_dict()})
    normalisation = Normalisation(*(tensors[f"normalisation.{name}"].numpy() for name in NORMALISATION))
    return Weights(
        network.eval(),
        described.basis,
        normalisation,
        described.class_names,
        tensors["class_colours"].numpy(),
        described.record,
    )


def read_tensors(path: Path, described: Description) -> dict[str, Tensor]:
    """Read the network's tensors of a file, after its header was held against what the description asks for.

    Raises WeightsError as ``load_weights``.
    """
    parts = (f"{OOD}.", f"{READER}.")
    with _told_as(path):
        check_shapes(described.config, claimed_shapes(path))
        tensors = checksummed_files.read_tensors(path, described.about, lambda name: not name.startswith(parts))
        check_numbers(tensors, (SPREAD,))
    return tensors


def describe_weights(path: Path) -> Description:
    """Read what a file of weights says of itself, in milliseconds.

    Raises WeightsError where it is missing, cut short, of another format, or where its description is damaged or asks
    for what cannot be.
    """
    if not path.is_file():
        raise WeightsError(f"no weights at {path}; train some with: spectralzoom train DATASET -o {path.name}")
    with _told_as(path):
        about = read_about(path, FORMAT)
    try:
        config, basis = SegmenterConfig(**about["config"]), SpectralBasis(**about["basis"])
        names, record = tuple(map(str, about["class_names"])), dict(about["record"])
        check_basis(basis, config.columns)
        keys = about["keys"]
        ood_detector = OodPart.read(keys[OOD], about[OOD]) if OOD in about else None
        reader = ReaderPart.read(keys[READER], about[READER], config) if READER in about else None
        key = str(keys["weights"])
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: its description is damaged ({error}); copy or train the file again") from error
    if len(names) != config.classes:
        raise WeightsError(f"{path} names {len(names)} classes, its segmenter has {config.classes}")
    return Description(config, basis, names, record, key, ood_detector, reader, about)


def with_record(weights: Weights, **entries: Any) -> Weights:
    """Give the same weights with entries added to their record."""
    return replace(weights, record={**weights.record, **entries})


def check_shapes(config: SegmenterConfig, claimed: Mapping[str, tuple[tuple[int, ...], str]]) -> None:
    """Refuse a file's header of which a tensor is not as the config asks (NotSealedError). Reads no numbers.

    Shapes are those of the network on torch's meta device, where tensors have a size and no memory.
    """
    one, all_pairs = (config.columns,), (config.columns, config.columns)
    with torch.device("meta"):
        network = segmenter.Segmenter(config)
    wanted = {name: (tuple(value.shape), "F32") for name, value in network.state_dict().items()}
    wanted |= {"normalisation.centre": (one, "F32"), SPREAD: (one, "F32")}
    wanted |= {"normalisation.whitening": (all_pairs, "F32"), "class_colours": ((config.classes, 3), "U8")}
    for name, (shape, kind) in wanted.items():
        came, word = claimed.get(name, ("nothing", kind))
        if came != shape:
            raise NotChecksummedError(f"does not fit: tensor {name} should be {shape}, the file has {came}")
        if word != kind:
            raise NotChecksummedError(f"does not fit: tensor {name} should be of {KINDS[kind]}, the file has {word}")


def check_numbers(tensors: Mapping[str, Tensor], spreads: Sequence[str]) -> None:
    """Refuse numbers that nothing can be computed with (NotSealedError); those of ``spreads`` are divided by."""
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            count = int((~torch.isfinite(value)).sum())
            raise NotChecksummedError(f"is damaged: {count} of {value.numel()} numbers of tensor {name} are not finite")
    for name in spreads:
        if not bool((tensors[name] > 0).all()):
            raise NotChecksummedError(f"is damaged: tensor {name} holds a spread that is not above 0")
