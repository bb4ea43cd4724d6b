"""The built-in farms by name: ``farm@1`` is one day of June, ``farm@2`` any day of the year; ``farm`` is one of them.

A law is what a seed is drawn by; it stands first in a scene's key, and one that is out there never changes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.errors import SceneError

if TYPE_CHECKING:
    from pipeline.geometry.camera import LineCamera
    from pipeline.simulator.scene import RasterScene

FARM_LAW, SEASON_LAW = "farm@1", "farm@2"
BUILT_IN_SCENE = SEASON_LAW  # what ``farm`` stands for, and what the weights that come with the house were trained on
FARM_NAMES = ("farm", FARM_LAW, SEASON_LAW)
FARM_SHAPE = (1024, 1280)  # (y, x) unless another is asked for [px]
USUAL_DAY, USUAL_HOUR = 172, 11.0  # of ``farm@2``: the 21st of June, an hour before noon


def farm_law(name: str) -> str:
    """Give the law that a name stands for: ``farm`` for the present one, a law for itself.

    Raises
    ------
    SceneError : no farm is called so.
    """
    if name not in FARM_NAMES:
        raise SceneError(f"no built-in scene is called {name!r}; there are {', '.join(FARM_NAMES)}")
    return BUILT_IN_SCENE if name == "farm" else name


def law_of_key(key: str) -> str | None:
    """Give the law that a scene with this key was drawn by; None of any other scene."""
    law = key.partition("/")[0]
    return law if law in (FARM_LAW, SEASON_LAW) else None


def has_days(name: str) -> bool:
    """Whether the scene of a name looks different by day and hour."""
    return name in FARM_NAMES and farm_law(name) == SEASON_LAW


def built_in_farm(
    name: str,
    seed: int,
    shape: tuple[int, int] = FARM_SHAPE,
    *,
    camera: LineCamera | None = None,
    day: int | None = None,
    hour: float | None = None,
) -> RasterScene:
    """Open a built-in farm, (y, x) px; it is drawn when first looked at.

    Parameters
    ----------
    day
        Of the year, 1 to 366; by default 172.
    hour
        True solar time, the sun in the south at 12; by default 11. [h]

    Raises
    ------
    SceneError : no such farm, a negative seed, an empty shape, day or hour of one that has none, or the sun below 5
        degrees.
    """
    from pipeline.simulator.farm import farm_scene
    from pipeline.simulator.farm_on_day import farm_on_day

    if has_days(name):
        on = USUAL_DAY if day is None else day
        at = USUAL_HOUR if hour is None else hour
        return farm_on_day(seed, shape, camera=camera, day=on, hour=at)
    law = farm_law(name)
    if day is not None or hour is not None:
        raise SceneError(f"the scene {law} is of one day and hour; take {SEASON_LAW} to choose them")
    return farm_scene(seed, shape, camera=camera)
