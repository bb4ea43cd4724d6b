"""What a survey found out on the way, in sentences: for the terminal and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

LEAST_HECTARES = 0.1  # smaller areas are told in square metres


def sentences(found: Mapping[str, Any]) -> list[str]:
    """The findings in words, for the terminal and the report."""
    words = _plan_words(found["plan"]) if "plan" in found else []
    for name, one in found.get("pointing", {}).items():
        if isinstance(one, Mapping):
            words.append(_pointing_words(name, one))
    for sweep, facts in found.get("lines", {}).items():
        told = ", ".join(f"{count} {what}" for what, count in facts.items() if count)
        words.append(f"Sweep {sweep}: lines {told}; what they would have shown is left out.")
    if "ground" in found:
        ground = found["ground"]
        areas = [f"{name.replace('_', ' ')} {area_words(area)}" for name, area in ground["areas_ha"].items() if area]
        place = f"{ground['crs']}, {ground['resolution_m']:g} m a pixel"
        words.append(f"On the ground ({place}) the classes cover {', '.join(areas)}.")
    return words


def _plan_words(plan: Mapping[str, Any]) -> list[str]:
    words = []
    if plan["kind"] == "full" and plan["reason"]:
        words.append(_sentence(plan["reason"]))
    if plan["out_of_reach"]:
        words.append(f"{plan['out_of_reach']} places worth a second look lie beyond the mirror's range.")
    words.append(_sentence(plan["orientation"]["sentence"]))
    return words


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _pointing_words(name: str, one: Mapping[str, Any]) -> str:
    most = max((float(np.hypot(*offset)) for offset in one["sweeps"].values()), default=0.0)
    left = one["residual_rms_px"]
    text = f"The {name} sweeps were put right by up to {most:.1f} px"
    text += "." if left is None else f"; {left:.2f} px rms are left at the seams."
    if one["not_found"]:
        text += f" Nothing could be told of {', '.join(one['not_found'])}."
    if one["too_narrow"]:
        text += f" {len(one['too_narrow'])} overlaps were too narrow to compare."
    return text


def area_words(hectares: float) -> str:
    """An area in hectares, small ones in square metres."""
    return f"{hectares:.3g} ha" if hectares >= LEAST_HECTARES else f"{hectares * 1e4:.3g} m²"
