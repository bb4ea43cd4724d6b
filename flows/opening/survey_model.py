"""Open the weights of a survey."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from spectralzoom.flows.settings.load import FLAG, flag_of
from spectralzoom.flows.settings.rules import mistakes
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES
from spectralzoom.models.network.machine import choose_device
from spectralzoom.models.weights.files import (
    TRAINED_ON,
    Description,
    TrainedOn,
    Weights,
    describe_weights,
    load_reader,
    load_weights,
)
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.once import Once


@dataclass(frozen=True)
class SurveyModel:
    """Weights of a survey."""

    path: Path
    described: Description
    load: Once[Weights]

    @staticmethod
    def open(path: Path, device: str, *, planning: bool) -> SurveyModel:
        """Open the weights of a file; all tensors are read unless for ``planning``.

        Raises WeightsError: the file is missing, damaged or inconsistent; SettingsError: the machine lacks the device.
        """
        described = describe_weights(path)
        load = Once(lambda: load_weights(path, described).on(choose_device(device)))
        if not planning:
            load()
            if described.reader is not None:
                load_reader(path, described)
        return SurveyModel(path, described, load)

    @staticmethod
    def unread() -> SurveyModel:
        """Return the patch size of the shipped weights alone, for a survey that ends before a network reads."""
        path = shipped_weights()
        described = describe_weights(path)
        return SurveyModel(
            path,
            Description(described.config, described.basis, (), {}, described.key, about=described.about),
            Once(lambda: load_weights(path)),
        )

    @property
    def reads(self) -> bool:
        """Return whether the survey has weights of its own."""
        return bool(self.described.class_names)

    @property
    def trained_on(self) -> TrainedOn | None:
        """Return the record of the training data; None where the weights have none."""
        known = self.described.record.get(TRAINED_ON)
        return None if known is None else TrainedOn.read(known)


def weights_path(settings: Settings) -> Path:
    """Return the file of weights: that of the settings, or the shipped one for built-in scenes.

    Raises SettingsError: there is none for another scene. A survey that `Settings.ends_unread` needs none.
    """
    if settings.weights not in (None, *BUILT_IN_SCENES):
        return Path(str(settings.weights))
    if settings.weights is None and settings.scene not in BUILT_IN_SCENES:
        raise SettingsError(
            f"--weights is missing: the weights that come with SpectralZoom know farm, scouting and trial only;"
            f" train some for {settings.scene} with: spectralzoom train DATASET -o my.safetensors{_unread(settings)}"
        )
    return shipped_weights()


def _unread(settings: Settings) -> str:
    """Return the flags by which these settings need no weights, as a sentence behind another; empty without any."""
    for flags in ({"until": "mosaic"}, {"until": "mosaic", "scan_step": 1}):
        asked = settings.but(**flags)
        stated = dict.fromkeys((*settings.model_fields_set, *flags), FLAG)
        if asked.ends_unread and not any(mistakes(asked, stated)):
            return f". A mosaic needs none: {' '.join(f'{flag_of(name)} {value}' for name, value in flags.items())}"
    return ""


def shipped_weights() -> Path:
    """Return the file of the shipped weights."""
    return Path(str(resources.files("spectralzoom.models") / "shipped" / "farm.safetensors"))
