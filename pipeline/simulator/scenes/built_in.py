"""The built-in scenes by name: the dense farm, and the scouted field."""

from __future__ import annotations

from typing import Any

from pipeline.simulator.scenes.farm.farm_scene import FARM_LAW, FARM_NAMES, farm_scene
from pipeline.simulator.scenes.farm.scouting import SCOUTING_LAW, SCOUTING_NAMES, scouting_scene
from pipeline.simulator.scenes.scene import RasterScene

BUILT_IN_NAMES = (*FARM_NAMES, *SCOUTING_NAMES)
LAWS = dict.fromkeys(FARM_NAMES, FARM_LAW) | dict.fromkeys(SCOUTING_NAMES, SCOUTING_LAW)  # by the names of scenes


def built_in_scene(name: str, seed: int, *args: Any, **moment: Any) -> RasterScene:
    """Draw the built-in scene of a name; arguments and errors are those of `farm_scene` and `scouting_scene`."""
    if LAWS[name] == FARM_LAW:
        return farm_scene(seed, *args, **moment)
    return scouting_scene(seed, *args, **moment)


def is_built_in_key(key: str) -> bool:
    """Return whether a scene's key is of a built-in scene."""
    return key.partition("/")[0] in (FARM_LAW, SCOUTING_LAW)


def built_in_laws(names: str) -> tuple[str, ...]:
    """Laws of built-in scenes named with commas; none where one of them is not built in."""
    parts = [part.strip() for part in names.split(",")]
    return tuple(dict.fromkeys(LAWS[part] for part in parts)) if all(part in LAWS for part in parts) else ()
