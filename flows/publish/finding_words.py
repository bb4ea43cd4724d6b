"""What a survey found out on the way, in sentences: for the terminal and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flows.terminal.figures import format_percent

LEAST_HECTARES = 0.1  # smaller areas are told in square metres


def sentences(found: Mapping[str, Any]) -> list[str]:
    """The findings in words, for the terminal and the report."""
    words = _plan_words(found["plan"]) if "plan" in found else []
    for name, one in found.get("pointing", {}).items():
        if isinstance(one, Mapping) and (told := _pointing_words(name, one)):
            words.append(told)
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
    if plan.get("spared_s"):
        words.append(_spared_words(plan))
    if plan["lines"]:
        words.append(_sentence(plan["orientation"]["sentence"]))
    return words


def _spared_words(plan: Mapping[str, Any]) -> str:
    share = f" ({format_percent(plan['spared_share'])} of the full scan's)" if plan["spared_share"] else ""
    return (
        f"The threshold of {plan['threshold']:g} a second left {plan['spared_s']:.1f} s{share} unspent: no further run "
        f"of lines pays."
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _pointing_words(name: str, one: Mapping[str, Any]) -> str:
    put = [float(np.hypot(*offset)) for sweep, offset in one["sweeps"].items() if sweep not in one["not_found"]]
    left, text = one["residual_rms_px"], ""
    if len(one["sweeps"]) == 1 and one["held"] in one["sweeps"]:
        text = f"The {name} pass is one sweep, which has no seam to be put right by."
    elif put:
        rest = "" if left is None else f"; {left:.2f} px rms are left at the seams"
        text = f"The {name} sweeps were put right by up to {max(put):.1f} px{rest}."
    if one["not_found"]:
        text += f" Nothing could be told of {', '.join(one['not_found'])}: left where the mirror reported."
    if one["too_narrow"]:
        text += f" {len(one['too_narrow'])} overlaps were too narrow to compare."
    if one.get("partly_seen"):
        text += (
            f" {one['partly_seen']} chosen places were not seen whole; what is missing of them is mapped by the coarse "
            f"look."
        )
    return text.strip()


def area_words(hectares: float) -> str:
    """An area in hectares, small ones in square metres."""
    return f"{hectares:.3g} ha" if hectares >= LEAST_HECTARES else f"{hectares * 1e4:.3g} m²"
