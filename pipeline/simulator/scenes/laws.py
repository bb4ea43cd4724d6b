"""Names and laws of the built-in scenes, and what a farm is unless something else is asked for."""

from __future__ import annotations

# A law is what a seed is drawn by; it stands first in a scene's key, and one that is out there never changes.
FARM_LAW = "farm@2"
FARM_NAMES = ("farm", FARM_LAW)
FARM_SHAPE = (1024, 1280)  # (y, x) unless another is asked for [px]
FARM_PIXEL_M = 0.12  # of the ground that a pixel shows
USUAL_DAY, USUAL_HOUR = 172, 11.0  # the 21st of June, an hour before noon
TRIAL_LAW = "trial@1"
TRIAL_NAMES = ("trial", TRIAL_LAW)
SCOUTING_LAW = "scouting@1"
SCOUTING_NAMES = ("scouting", SCOUTING_LAW)
BUILT_IN_NAMES = (*FARM_NAMES, *SCOUTING_NAMES, *TRIAL_NAMES)
LAWS = {
    name: law
    for names, law in ((FARM_NAMES, FARM_LAW), (SCOUTING_NAMES, SCOUTING_LAW), (TRIAL_NAMES, TRIAL_LAW))
    for name in names
}


def built_in_laws(names: str) -> tuple[str, ...]:
    """Return laws of built-in scenes named with commas; none where one of them is not built in."""
    parts = [part.strip() for part in names.split(",")]
    return tuple(dict.fromkeys(LAWS[part] for part in parts)) if all(part in LAWS for part in parts) else ()
