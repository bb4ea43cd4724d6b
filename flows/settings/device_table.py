"""The table [rig] of the settings: where the rig's devices are, and what is believed of them; every key checked."""

from __future__ import annotations

from collections.abc import Callable

from flows.settings.values import Span, parse_choice, parse_number, parse_switch, parse_text, parse_whole
from pipeline.geometry.mounting import AXES

Parser = Callable[[object, str], object]


def parse_any_text(value: object, place: str) -> str:
    """Text, or none of it."""
    return "" if value == "" else parse_text(value, place)


MOST_PAIRS = 8191  # cells of the vector memory are addressed by a byte offset of 16 bits
RIG: dict[str, Parser] = {
    "port": parse_text,
    "baud": parse_whole(1200, 4_000_000),
    "expected_id": parse_any_text,
    "deadline_s": parse_number(Span(0.01, 60, "s")),
    "retries": parse_whole(0, 20),
    "quiet_s": parse_number(Span(0, 5, "s")),
    "with_crc": parse_switch,
    "strict_crc": parse_switch,
    "ends": parse_choice(("exclusive", "inclusive")),
    "read_back": parse_choice(("none", "sampled", "all")),
    "check_status": parse_switch,
    "park_at_close": parse_switch,
    "log_rate_hz": parse_number(Span(0.1, 10_000, "hz")),
    "log_samples": parse_whole(1, 16_383),
    "mirror_axes": parse_choice(AXES, separator="  "),
    "mirror_clocking_deg": parse_number(Span(-45, 45, "deg")),
    "mirror_offset_x": parse_number(Span(-0.5, 0.5, "")),
    "mirror_offset_y": parse_number(Span(-0.5, 0.5, "")),
    "host": parse_text,
    "control_port": parse_whole(1, 65_535),
    "file_port": parse_whole(1, 65_535),
    "user": parse_text,
    "password": parse_text,
    "connect_s": parse_number(Span(0.1, 60, "s")),
    "stall_s": parse_number(Span(0.1, 600, "s")),
    "least_kb_s": parse_number(Span(0.001, 1e6, "kb_s")),
    "read_twice": parse_switch,
    "pulses": parse_choice(("position", "frame", "none")),
    "log_pulses": parse_switch,
    "settle_s": parse_number(Span(0.01, 60, "s")),
    "panel": parse_number(Span(1e-6, 1e6, "")),
    "white_at_rest": parse_switch,
    "provenance": parse_text,
}
