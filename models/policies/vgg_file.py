"""The file of VGG19 that a survey was given: found and named without torch, read once a process."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from models.network.sizes import TRAINED_VGG_FROM, VGG_FROM
from pipeline.errors import SettingsError, WeightsError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import models.policies.vgg as vgg
    from models.policies.vgg import VggFeatures
    from models.training.pretrained import LoadReport
    from models.weights.files import Weights
else:
    vgg = deferred("models.policies.vgg")


@dataclass(frozen=True)
class VggFile:
    """A file of VGG19 by its path, and the hash that it had when the survey began."""

    path: Path
    key: str
    trained: bool = False  # on data of one's own: it may read other channels than photographs have

    @staticmethod
    def found(path: Path, *, trained: bool = False) -> VggFile:
        """Take the file as it is now. Raises SettingsError where there is none, saying what could stand there."""
        if not path.is_file():
            raise SettingsError(f"no file {path}; --vgg takes {TRAINED_VGG_FROM if trained else VGG_FROM}")
        return VggFile(path.resolve(), _hash(path), trained)

    @property
    def channels(self) -> int:
        """How many it reads; photographs have three. Raises WeightsError as `report`."""
        return _network_at(self)[0].sizes.channels if self.trained else 3

    def report(self) -> LoadReport:
        """What was taken from it. Raises WeightsError: another network, damaged, or changed since."""
        return _network_at(self)[1]

    def saliency(self, weights: Weights) -> vgg.VggSaliency:
        """Give the policy for looks with the columns of ``weights``.

        Raises WeightsError as `report`, or its channels are none that these weights can give.
        """
        network = _network_at(self)[0]
        return vgg.VggSaliency(network, vgg.channels_of(weights, network) if self.trained else vgg.colours_of(weights))


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:20]


@lru_cache(maxsize=1)
def _network_at(file: VggFile) -> tuple[VggFeatures, LoadReport]:
    loaded = vgg.load_vgg(file.path, trained=file.trained)
    if _hash(file.path) != file.key:
        raise WeightsError(f"the VGG19 {file.path} has changed since the survey began; start it again")
    return loaded
