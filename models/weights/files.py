"""Read and write weights: one checksummed file with tensors, spectral basis, classes and the record of the training.

The file may also hold a temporal reader, the calibration of expected scores and statistics of the training spectra,
which do not change its key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.evaluation.expected_scores import MapScores
from spectralzoom.models.evaluation.unlike_scenes import TrainingSpectra
from spectralzoom.models.network.sizes import SegmenterConfig, TemporalSizes
from spectralzoom.models.network.spectral import Normalisation, SpectralBasis, checked_wavelengths, project
from spectralzoom.models.weights.checksummed_files import key_of, read_about, read_tensors, refusing, write_checksummed
from spectralzoom.models.weights.ranges import check_ranges, check_record
from spectralzoom.pipeline.errors import WavelengthError, WeightsError
from spectralzoom.pipeline.readings import readings_alone
from spectralzoom.pipeline.signal.components import Components

if TYPE_CHECKING:
    from torch import Tensor

    from spectralzoom.models.network.segmenter import Segmenter
    from spectralzoom.models.network.temporal_reader import TemporalReader

NORMALISATION = ("centre", "spread", "whitening")
FORMAT = "spectralzoom-weights/7"
ENCODER = "spectralzoom-encoder/1"
COLOURS = "class_colours"
CAPTURED = "captured"  # of a record: scenes were captured by the simulated camera, not taken as they are
PLAIN = "plain"  # of a record: number of the mixture's part that is the best classifier of single spectra
SCANS = "scans"  # of a record: scores of uniform scans
BY_LAW = "by_law"  # of these: scores on the built-in scenes of each law
CASCADE = "cascade"  # of a record: loss of reading some patches in full
CALIBRATION = "calibration"  # of a record: calibration error and temperature
READER = "memory"  # entry in the description, prefix of tensor names
CLASS_VALUES = "class_values"  # of a record
TRAINED_ON = "trained_on"  # entry in a record
MAP_SCORES = "map_scores"  # entry in the description: corrections of expected scores
SPECTRA = "spectra"  # entry in the description: statistics of the training spectra
MOST_WIDTH = 1024

Range = tuple[float, float]


@dataclass(frozen=True)
class TrainedOn:
    """Ranges of the training data; None where unknown."""

    bands: int
    wavelength_nm: Range
    exposure_ms: Range
    scenes: int
    classes: tuple[str, ...]
    day: tuple[int, int] | None = None  # of the year
    sun_elevation_deg: Range | None = None
    ground_pixel_m: float | None = None
    bands_nm: tuple[float, ...] | None = None  # centre of each band

    @staticmethod
    def read(content: Mapping[str, Any]) -> TrainedOn:
        """Read its values in a record. Raises TypeError for other entries."""
        plain: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in content.items()}
        return TrainedOn(**plain)


@dataclass(frozen=True)
class ReaderPart:
    """Description of the temporal reader."""

    key: str
    sizes: TemporalSizes
    record: Mapping[str, Any]

    @staticmethod
    def read(key: str, about: Mapping[str, Any], config: SegmenterConfig) -> ReaderPart:
        """Read an entry of a description. KeyError, TypeError, ValueError: invalid, or for another network."""
        sizes = TemporalSizes(**about["sizes"])
        if (sizes.classes, sizes.columns) != (config.classes, config.columns):
            raise ValueError(f"its temporal reader is for another network: {sizes}")
        if not 0 < sizes.width <= MOST_WIDTH or not 0 < sizes.coarse_width <= MOST_WIDTH:
            raise ValueError(f"its temporal reader is {sizes.width} and {sizes.coarse_width} wide")
        return ReaderPart(key, sizes, about["record"])


@dataclass(frozen=True)
class Description:
    """Description of a weights file, read without its tensors and without torch."""

    config: SegmenterConfig
    basis: SpectralBasis
    class_names: tuple[str, ...]
    record: dict[str, Any]
    key: str = ""  # hash of the weights
    map_scores: MapScores | None = None  # None without validation scenes, and for a single exposure
    reader: ReaderPart | None = None
    spectra: TrainingSpectra | None = None  # None for a training on few pixels
    about: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)  # complete, with hashes

    @property
    def untaught(self) -> tuple[str, ...]:
        """Return the names of the classes without a training pixel, which are never drawn."""
        return tuple(self.class_names[number] for number in self.config.untaught)

    def scans(self, law: str = "") -> Mapping[str, Any] | None:
        """Return the scores of uniform scans, on built-in scenes of a ``law`` if it was judged; None without any."""
        content: Mapping[str, Any] | None = self.record.get(SCANS)
        return None if content is None else content.get(BY_LAW, {}).get(law, content)


@dataclass(frozen=True)
class Weights:
    """A segmenter with its spectral basis, normalisation, classes, and the record of its training."""

    segmenter: Segmenter
    basis: SpectralBasis
    normalisation: Normalisation
    class_names: tuple[str, ...]
    class_colours: NDArray[np.uint8]  # (class, 3)
    record: dict[str, Any] = field(default_factory=dict)  # command, seed, data, split, validation

    @property
    def config(self) -> SegmenterConfig:
        """Return the sizes of the network."""
        return self.segmenter.config

    @property
    def class_values(self) -> tuple[int, ...]:
        """Return the number of each class in the label files of the training, by the record; empty if unknown."""
        return tuple(self.record.get(CLASS_VALUES) or ())

    @property
    def temperature(self) -> float:
        """Return the divisor of the logits of maps, by the record; 1 by default."""
        return float((self.record.get(CALIBRATION) or {}).get("temperature", 1.0))

    def columns(self, values: NDArray[np.floating], wavelength_nm: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return normalised spectral columns of pixels, (..., band) -> (..., column) float32.

        Columns without a valid band take their conditional mean. Values beyond `Normalisation.most_value` are invalid.
        A pixel with more than half of its bands invalid is NaN.
        """
        values = readings_alone(values, self.normalisation.most_value)
        matrix, reached = self.basis.matrix(wavelength_nm)
        return self._normalised(project(values, matrix), reached)

    def columns_of_scores(
        self, scores: NDArray[np.floating], components: Components, wavelength_nm: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Return normalised spectral columns of pixels by scores of components, (..., component) -> (..., column).

        Columns beyond `Normalisation.most_value` take their conditional mean; a pixel without scores is NaN.
        """
        lit = np.isfinite(components.mean)
        matrix = np.zeros((components.bands, self.config.columns), np.float32)
        matrix[lit], reached = self.basis.matrix(np.asarray(wavelength_nm)[lit])
        weights, offset = components.onto(matrix)
        with np.errstate(invalid="ignore", over="ignore"):
            projected = np.asarray(scores, np.float32) @ weights + offset
        return self._normalised(readings_alone(projected, self.normalisation.most_value), reached)

    def _normalised(self, projected: NDArray[np.float32], reached: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Normalise columns; NaN in pixels without a finite one."""
        columns = self.normalisation.apply(projected, reached)
        columns[~(np.isfinite(projected) & reached).any(axis=-1)] = np.nan
        return columns

    def on(self, device: str) -> Weights:
        """Move the network to a device of `models.network.machine.choose_device`, and return the weights."""
        self.segmenter.to(device)
        return self


def save_weights(weights: Weights, path: Path) -> None:
    """Write a checksummed file by a temporary name and a rename. Raises WeightsError for an error of the disk."""
    import torch

    tensors = {name: one for name, one in weights.segmenter.state_dict().items() if one.is_floating_point()}
    for name in NORMALISATION:
        tensors[f"normalisation.{name}"] = torch.from_numpy(getattr(weights.normalisation, name).copy())
    tensors[COLOURS] = torch.from_numpy(weights.class_colours.copy())
    about = {
        "config": asdict(weights.config),
        "basis": asdict(weights.basis),
        "class_names": list(weights.class_names),
        "record": weights.record,
    }
    write_checksummed(path, {**about, "format": FORMAT, "keys": {"weights": key_of(about, tensors)}}, tensors)


def add_map_scores(weights: Path, map_scores: MapScores) -> None:
    """Add the calibration of expected scores to a file of weights.

    Raises WeightsError: the file cannot be read or written.
    """
    _add_part(weights, weights, MAP_SCORES, map_scores.as_dict(), {})


def add_spectra(weights: Path, spectra: TrainingSpectra) -> None:
    """Add the statistics of the training spectra to a file of weights. Raises as `add_map_scores`."""
    _add_part(weights, weights, SPECTRA, spectra.as_dict(), {})


def add_reader(weights: Path, out: Path, reader: TemporalReader, record: Mapping[str, Any]) -> None:
    """Write the weights of a file with a temporal reader to ``out``. Raises as `add_map_scores`."""
    _add_part(weights, out, READER, {"sizes": asdict(reader.sizes), "record": dict(record)}, dict(reader.state_dict()))


def _add_part(source: Path, out: Path, part: str, about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    described = describe_weights(source)
    kept = read_tensors(source, described.about, lambda name: not name.startswith(f"{part}."))
    added = {f"{part}.{name}": tensor for name, tensor in tensors.items()}
    keys = {**described.about["keys"], part: key_of(about, tensors)}
    write_checksummed(out, {**described.about, "keys": keys, part: about}, kept | added)


def load_reader(weights: Path, described: Description | None = None) -> TemporalReader:
    """Load the temporal reader of weights, as ``described``. WeightsError: as `load_weights`, or none is there."""
    import torch

    described = described or describe_weights(weights)
    if described.reader is None:
        raise WeightsError(
            f"{weights} has no temporal reader; train one with: spectralzoom train DATASET --train-temporal "
            f"{weights} -o {weights}"
        )
    from spectralzoom.models.network.temporal_reader import TemporalReader

    with torch.device("meta"):
        reader = TemporalReader(described.reader.sizes)
    tensors = read_tensors(weights, described.about, lambda name: name.startswith(f"{READER}."))
    with refusing(weights):
        _check_numbers(tensors)
        reader.load_state_dict({name.removeprefix(f"{READER}."): one for name, one in tensors.items()}, assign=True)
    return reader.eval()


def load_weights(path: Path, described: Description | None = None) -> Weights:
    """Read a file of `save_weights`, as ``described``; no pickle is involved.

    Raises WeightsError: it is missing or of another format, or a tensor is damaged or of other weights than described,
    does not fit the config, or has a value that is not finite.
    """
    import torch

    from spectralzoom.models.network.segmenter import Segmenter

    described = described or describe_weights(path)
    config = described.config
    with torch.device("meta"):
        network = Segmenter(config)
    tensors = read_tensors(path, described.about, lambda name: not name.startswith(f"{READER}."))
    with refusing(path):
        _check_numbers(tensors)
        normalisation = Normalisation(*(tensors.pop(f"normalisation.{name}").numpy() for name in NORMALISATION))
        colours = tensors.pop(COLOURS).numpy()
        network.load_state_dict(tensors, assign=True)
        of_columns = (config.columns,)
        shapes = [*(getattr(normalisation, name).shape for name in NORMALISATION), colours.shape]
        if shapes != [of_columns, of_columns, of_columns * 2, (config.classes, 3)]:
            raise ValueError(f"normalisation and colours {shapes} do not fit {config.columns} columns")
        if not (normalisation.spread > 0).all():
            raise ValueError("normalisation.spread has a value that is not above 0")
    return Weights(network.eval(), described.basis, normalisation, described.class_names, colours, described.record)


def load_encoder() -> dict[str, Tensor]:
    """Read the encoder for large frames, trained on ImageNet, as tensors of the segmenter; a copy is shipped."""
    path = Path(str(resources.files("spectralzoom.models") / "shipped" / "imagenet.safetensors"))
    tensors = read_tensors(path, read_about(path, ENCODER))
    return {f"overview_stem.{name}": tensor for name, tensor in tensors.items()}


def describe_weights(path: Path) -> Description:
    """Read the description of a weights file.

    Raises WeightsError: it is missing, cut short or of another format, or its description is damaged or invalid.
    """
    if not path.is_file():
        what = f"the weights {path} are a folder, expected a file" if path.is_dir() else f"no weights at {path}"
        advice = "give others as --weights, or train some with: spectralzoom train DATASET -o FILE.safetensors"
        raise WeightsError(f"{what}; {advice}")
    anew = "leave out --weights for the built-in scenes, or train anew: spectralzoom train DATASET -o FILE"
    about = read_about(path, FORMAT, f"{anew}.safetensors")
    with refusing(path):
        config = SegmenterConfig(**about["config"])
        basis = SpectralBasis(**about["basis"])
        names = tuple(map(str, about["class_names"]))
        record = dict(about["record"])
        checked_wavelengths(np.array([basis.low_nm, basis.high_nm]))
        if basis.columns != config.columns or basis.low_nm > basis.high_nm:
            raise WavelengthError(
                f"a basis of {basis.columns} columns from {basis.low_nm:g} to {basis.high_nm:g} nm, expected "
                f"{config.columns} of them between ascending wavelengths"
            )
        check_record(record, len(config.parts))
        check_ranges(about.get(MAP_SCORES) or {})
        keys = about["keys"]
        map_scores = MapScores.read(about[MAP_SCORES]) if MAP_SCORES in about else None
        reader = ReaderPart.read(keys[READER], about[READER], config) if READER in about else None
        spectra = TrainingSpectra.read(about[SPECTRA], config.columns) if SPECTRA in about else None
        if len(names) != config.classes:
            raise ValueError(f"it names {len(names)} classes, its segmenter has {config.classes}")
        return Description(config, basis, names, record, str(keys["weights"]), map_scores, reader, spectra, about)


def with_record(weights: Weights, **entries: Any) -> Weights:
    """Return the weights with entries added to their record."""
    return replace(weights, record={**weights.record, **entries})


def _check_numbers(tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError for tensors that are not of float32 (colours: uint8), or not finite."""
    import torch

    for name, value in tensors.items():
        kind = torch.uint8 if name == COLOURS else torch.float32
        if value.dtype != kind:
            raise ValueError(f"tensor {name} is of {value.dtype}, expected {kind}")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"tensor {name} has numbers that are not finite")
