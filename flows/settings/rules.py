"""What settings may not be together: rules that no key can check alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from flows.settings.survey_settings import BUILT_IN_SCENES, RIG_FIELD, MapChoice, Settings
from models.network.sizes import TRAINED_VGG_FROM, VGG_FROM
from pipeline.errors import SettingsError
from pipeline.rig.device_settings import MOST_PAIRS
from pipeline.simulator.scenes.farm.farm_scene import FARM_LAW

IN_NAT = ("gain", "entropy")  # policies whose scores are gains, or the most that these can be
_VGG_FROM = {"vgg-static": VGG_FROM, "vgg-trained": TRAINED_VGG_FROM}  # policies that read a file of VGG19


def check_together(settings: Settings, origin: Mapping[str, str]) -> None:
    """Refuse what no key can say alone (SettingsError); ``origin`` tells where each (dotted) key came from."""
    for wrong in _wrongs(settings, origin):
        raise SettingsError(wrong)


def _wrongs(settings: Settings, origin: Mapping[str, str]) -> Iterator[str]:
    """What does not go together, and what to do about it."""
    policy, scene, air, camera = settings.policy, settings.scene, settings.air, settings.camera
    if (policy == "mask") != (settings.mask is not None):
        wants = "policy 'mask' needs a mask file" if settings.mask is None else "a mask is used by policy 'mask' only"
        yield f"{wants}: got policy = {policy!r}, mask = {settings.mask!r}; give both or neither"
    vgg_from = _VGG_FROM.get(policy)
    if vgg_from is not None and settings.vgg is None:
        yield f"policy {policy!r} needs --vgg FILE, {vgg_from}"
    if vgg_from is None and settings.vgg is not None:
        wanted = " or ".join(map(repr, _VGG_FROM))
        yield f"a vgg file is for policy {wanted}, got policy = {policy!r}; leave --vgg out"
    if settings.threshold is not None and policy not in IN_NAT:
        yield (
            f"threshold is a gain [nat], and policy {policy!r} scores in a unit of its own: leave --threshold out, or "
            f"take --policy {' or '.join(IN_NAT)} (entropy is the most that a look can gain)"
        )
    bands, wavelengths = settings.bands, settings.wavelengths
    if bands is not None and wavelengths is not None and len(bands) != len(wavelengths):
        place = place_of("wavelengths", origin.get("wavelengths"))
        yield f"{place} must have one value for each of the {len(bands)} bands, got {len(wavelengths)}"
    if scene == RIG_FIELD and settings.source != "rig":
        yield f"scene {RIG_FIELD!r} is what stands before a rig: give --source rig, or a file"
    if settings.size is not None and scene not in (*BUILT_IN_SCENES, RIG_FIELD):
        yield f"size is for built-in scenes ({', '.join(BUILT_IN_SCENES)}); {scene} has its own"
    for name, value in {"day": settings.day, "hour": settings.hour}.items():
        if value is not None and scene not in BUILT_IN_SCENES:
            yield (
                f"{place_of(name, origin.get(name))} = {value:g} is for the scene {FARM_LAW}, whose fields grow; "
                f"{scene} is as it is: leave it out"
            )
    if camera.dark_dn >= camera.full_scale_dn:
        yield (
            f"camera.dark_dn = {camera.dark_dn:g} leaves no room below the {camera.full_scale_dn} DN of {camera.bits} "
            "bits; use a smaller dark level"
        )
    for name, metres in {"nearest_m": air.nearest_m, "farthest_m": air.farthest_m}.items():
        if metres is not None and air.distance_m is None:
            yield f"air.{name} = {metres:g} needs air.distance_m, how far the middle of the scene is"
    distances = settings.simulated_rig.distances_m
    if distances is not None and distances[0] > distances[1]:
        yield f"air.nearest_m = {distances[0]:g} lies beyond air.farthest_m = {distances[1]:g}"
    pairs = settings.cost.vector_pairs
    if settings.source == "rig" and not 2 <= pairs <= MOST_PAIRS:
        yield f"cost.vector_pairs = {pairs}: the mirror's vector memory takes 2 to {MOST_PAIRS} pairs; give what it has"
    if settings.pose is None and settings.map != MapChoice():
        yield "[map] says how to draw the ground, which needs to know where the rig stands: give [pose]"


def place_of(key: str, origin: str | None) -> str:
    """How a message names a setting: as a flag (without the table that holds it), or in its file."""
    if origin == "flag":
        return "--" + key.rpartition(".")[2].replace("_", "-")
    return f"'{key}'" + (f" in {origin}" if origin else "")
