"""The report: one HTML page from a receipt and its pictures, for a farmer first and for whoever reruns it below.

Nothing is loaded from anywhere: styles are inline, pictures are data in the page. It opens from disk and prints.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

from flows.publish.effect_table import format_change, total_words
from flows.publish.finding_words import sentences
from flows.publish.page_parts import escape, page_row, page_section, page_table
from flows.publish.receipt import Accuracy, Receipt, Saving, Savings
from flows.publish.receipt_table import COST_LABELS, control_seats, headline
from flows.survey.scores import SHOWN, SHOWN_WORDS, definitions_differ, false_class_words
from flows.terminal.figures import DASH, format_bytes, format_percent, format_points, format_seconds


@dataclass(frozen=True)
class Picture:
    """A PNG with the words below it."""

    png: bytes
    caption: str


def write_report(
    path: str | Path,
    receipt: Receipt,
    quicklook_png: bytes,
    pictures: Iterable[Picture] = (),
    *,
    looked_twice: float | None = None,
) -> None:
    """Write the page.

    Parameters
    ----------
    pictures
        More pictures, shown below the quicklook.
    looked_twice
        Share of the field captured in detail, 0..1, for the first sentence; None leaves it out.

    Raises
    ------
    OSError : the file cannot be written.
    """
    page = render_report(receipt, quicklook_png, pictures, looked_twice=looked_twice)
    Path(path).write_text(page, encoding="utf-8")


def render_report(
    receipt: Receipt, quicklook_png: bytes, pictures: Iterable[Picture] = (), *, looked_twice: float | None = None
) -> str:
    """The page as text; every word of the receipt is escaped."""
    sections = [
        _figure(Picture(quicklook_png, "The survey at a glance.")),
        _savings(receipt["savings"]),
        _found(receipt),
        _accuracy(receipt["accuracy"]) if "accuracy" in receipt else "",
        *(_figure(picture) for picture in pictures),
        _stages(receipt["stages"]),
        _effects(receipt["effects"], receipt.get("effects_total")) if receipt.get("effects") else "",
        _details("Settings", _flat(receipt["settings"])),
        _details("Versions", receipt["versions"]),
        _details("Files of this survey", receipt["products"]),
    ]
    about = f"{receipt['scene']} seen by {receipt['source']}, seed {receipt['seed']}, finished {receipt['finished']}"
    return _PAGE.substitute(
        title=escape(receipt["survey"]),
        about=escape(about),
        headline=escape(headline(receipt, looked_twice)),
        style=PAGE_STYLE,
        body="\n".join(section for section in sections if section),
    )


def _found(receipt: Receipt) -> str:
    """What the survey found out on the way, in sentences."""
    words = sentences(receipt)
    if not words:
        return ""
    return page_section("How it was captured", "".join(f"<p>{escape(sentence)}</p>" for sentence in words))


def _figure(picture: Picture) -> str:
    data, words = base64.b64encode(picture.png).decode("ascii"), escape(picture.caption)
    return f'<figure><img src="data:image/png;base64,{data}" alt="{words}"><figcaption>{words}</figcaption></figure>'


def _savings(savings: Savings) -> str:
    """What was spent against everything: a bar for the ratio, the figures beside it."""
    entries: Mapping[str, Any] = savings
    rows = [_saving_row(label, show, entries[name]) for name, (label, show) in COST_LABELS.items()]
    if "segment_wall_s" in savings:
        done, full = savings["segment_wall_s"]["done"], savings["segment_wall_s"]["full"]
        entry: Saving = {"done": done, "full": full, "ratio": done / full if full else None, "full_is": "measured"}
        rows.append(_saving_row("time of the model", format_seconds, entry))
    head = page_row("th", ["", "share of everything", "this survey", "everything", "everything is"])
    split = savings["multiply_adds"]
    parts: Mapping[str, Any] = split
    shares = ", ".join(
        f"{name} {format_percent(parts[name] / split['done'])}"
        for name in ("glance", "score", "encode", "decode")
        if split["done"] and parts[name] is not None
    )
    note = f"<p class=note>Of the multiply-adds: {shares}.</p>" if shares else ""
    words = "Everything: the cheapest scan of the whole field at full resolution, with the same settings."
    return page_section("What it cost", f"<p>{words}</p>{page_table([head, *rows])}{note}")


def _saving_row(label: str, show: Any, entry: Saving) -> str:
    cells = [_bar(entry["ratio"]), escape(show(entry["done"])), escape(show(entry["full"])), escape(entry["full_is"])]
    return page_row("td", [escape(label), *cells])


def _bar(share: float | None, words: str | None = None) -> str:
    """A bar of a share 0..1; above 1 it is full and of another colour."""
    if share is None:
        return DASH
    width, over = 100 * min(max(share, 0.0), 1.0), " over" if share > 1 else ""
    text = words or format_percent(share)
    return f'<span class="bar{over}"><i style="width:{width:.1f}%"></i></span><b>{text}</b>'


def _accuracy(accuracy: Accuracy) -> str:
    """The map against the truth, beside no detail, all detail and other placements; then class by class."""
    seats = control_seats(accuracy)
    scores: list[tuple[str, Mapping[str, Any]]] = [
        ("the coarse look alone (none)", accuracy["none"]),
        *((escape(f"{seats} placed by {policy}"), control) for policy, control in accuracy["controls"].items()),
        ("<strong>this survey</strong>", accuracy),
        ("detail everywhere (all)", accuracy["all"]),
    ]
    before = definitions_differ([score for _, score in scores])
    head = page_row("th", ["", "mIoU", "overall", *([SHOWN] if before else [])])
    rows = [_score_row(label, score, before=before) for label, score in scores]
    gap = accuracy["gap_closed"]
    words = (
        "The score is the mean over the classes of the truth of overlap / union of map and truth (mIoU), in points "
        "of 100, and beside it the share of all pixels that are right (overall)."
    )
    words += f" {SHOWN_WORDS}" if before else ""
    closed = "" if gap is None else f" The detail captured closed {format_percent(gap)} of the gap from none to all."
    body = f"<p>{words}{closed}</p>{page_table([head, *rows])}{_control_words(accuracy)}{_classes(accuracy)}"
    return page_section("How good the map is", body)


def _control_words(accuracy: Mapping[str, Any]) -> str:
    """What the controls' seats stand for in samples, lines and seconds."""
    mode = accuracy.get("controls_mode")
    if mode is None:
        return ""
    shares = [format_percent(mode[f"share_of_{what}"]) for what in ("samples", "lines", "seconds")]
    return (
        f"<p class=note>Controls choose {mode['seats']:,} seats free of each other. Placed by gain and with the "
        f"coarse pass these are {shares[0]} of a full scan's samples; the camera would need {shares[1]} of its "
        f"lines and {shares[2]} of its seconds for them.</p>"
    )


def _score_row(label: str, score: Mapping[str, Any], *, before: bool) -> str:
    """The scores of one map; ``label`` is escaped, ``before`` adds the mean by the definition of before."""
    miou, spread = score["miou"], score.get("spread")
    text = format_points(miou) + ("" if spread is None else f" ± {format_points(spread)}")
    more = ("overall_accuracy", *(["miou_of_shown_classes"] if before else []))
    return page_row("td", [label, _bar(miou, text), *(format_points(score.get(name)) for name in more)])


def _classes(accuracy: Accuracy) -> str:
    head = page_row("th", ["class", "this survey", "none", "all"])
    rows = [_class_row(name, accuracy) for name in accuracy["per_class_iou"]]
    counted = sum(value is not None for value in accuracy["per_class_iou"].values())
    note = f"{counted} of {len(rows)} classes are in the truth and count in the mean. {false_class_words(accuracy)}"
    return f"<h3>Class by class</h3>{page_table([head, *rows])}<p class=note>{escape(note.rstrip())}</p>"


def _class_row(name: str, accuracy: Accuracy) -> str:
    none, full, iou = accuracy["none"], accuracy["all"], accuracy["per_class_iou"][name]
    others = [format_points(one["per_class_iou"].get(name)) for one in (none, full)]
    return page_row("td", [escape(name.replace("_", " ")), _bar(iou, format_points(iou)), *others])


def _stages(stages: Iterable[Mapping[str, Any]]) -> str:
    head = page_row("th", ["stage", "state", "wall", "processor", "peak memory", "read", "written", "key"])
    rows = [
        page_row(
            "td",
            [
                escape(stage["name"]),
                f'<span class="state {escape(stage["state"])}">{escape(stage["state"])}</span>',
                format_seconds(stage["wall_s"]),
                format_seconds(stage["cpu_s"]),
                format_bytes(stage["peak_rss_bytes"]),
                format_bytes(stage["bytes_in"]),
                format_bytes(stage["bytes_out"]),
                f"<code>{escape(str(stage['key'])[:12])}</code>",
            ],
        )
        for stage in stages
    ]
    return page_section("What was done", page_table([head, *rows]))


def _effects(effects: Iterable[Mapping[str, Any]], total: Mapping[str, Any] | None) -> str:
    """What was computed and what left out, effect by effect; receipts of before have no total."""
    head = page_row("th", ["effect", "state", "variant", "bound", "measured", "processor", "why"])
    rows = [
        page_row(
            "td",
            [
                escape(effect["name"].replace("-", " ")),
                f'<span class="state {"ran" if effect["state"] == "on" else "off"}">{escape(effect["state"])}</span>',
                escape(effect["variant"] or ""),
                escape(format_change(effect["bound"], endless="unit" in effect)),
                escape(format_change(effect["measured"])),
                format_seconds(effect["cost_s"]) if effect["cost_s"] else "",
                f'<span class="words">{escape(effect["why"] or "")}</span>',
            ],
        )
        for effect in effects
    ]
    words = "" if total is None else f"<p>{escape(' '.join(total_words(total)))}</p>"
    return page_section("What the simulator took into account", f"{words}{page_table([head, *rows])}")


def _details(title: str, items: Mapping[str, object]) -> str:
    rows = [
        page_row("td", [escape(str(name)), f"<code>{escape(_words(value))}</code>"]) for name, value in items.items()
    ]
    return f"<details><summary>{escape(title)}</summary>{page_table(rows)}</details>"


def _flat(settings: Mapping[str, Any]) -> dict[str, object]:
    """Tables within the settings as dotted names."""
    flat: dict[str, object] = {}
    for name, value in settings.items():
        inner = value.items() if isinstance(value, Mapping) else ()
        flat.update({f"{name}.{key}": item for key, item in inner} if isinstance(value, Mapping) else {name: value})
    return flat


def _words(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title – SpectralZoom</title>
<style>$style</style>
</head>
<body>
<main>
<header><p class="kicker">SpectralZoom survey</p><h1>$title</h1><p class="lead">$headline</p><p class="note">$about</p>
</header>
$body
</main>
</body>
</html>
""")  # noqa: RUF001

PAGE_STYLE = """
:root { color-scheme: light dark; --paper: #fbfaf7; --card: #ffffff; --ink: #22241f; --soft: #6a6d64; --line: #e3e1d8;
  --bar: #2f7d4f; --over: #c2571a; --track: #e9e7de; }
@media (prefers-color-scheme: dark) { :root { --paper: #161815; --card: #1e211d; --ink: #ecebe4; --soft: #a3a69b;
  --line: #343830; --bar: #58b27c; --over: #e08a50; --track: #31352e; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans",
  sans-serif; }
main { max-width: 70rem; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
.kicker { margin: 0; color: var(--bar); font-weight: 600; letter-spacing: .04em; }
h1 { margin: 0 0 .5rem; font-size: 2.2rem; line-height: 1.15; overflow-wrap: anywhere; }
h2 { margin: 0 0 .5rem; font-size: 1.3rem; } h3 { margin: 1.4rem 0 .4rem; font-size: 1.05rem; }
.lead { font-size: 1.25rem; line-height: 1.45; max-width: 52rem; margin: 0 0 .4rem; }
.note { color: var(--soft); font-size: .9rem; margin: .5rem 0 0; overflow-wrap: anywhere; }
section, details, figure { background: var(--card); border: 1px solid var(--line); border-radius: .6rem;
  padding: 1.1rem 1.3rem; margin: 1.2rem 0; }
section > p { margin: 0 0 .6rem; max-width: 52rem; }
figure { padding: .8rem; } figure img { display: block; width: 100%; height: auto; border-radius: .3rem; }
figcaption { color: var(--soft); font-size: .9rem; margin: .5rem .3rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { text-align: left; color: var(--soft); font-weight: 500; font-size: .85rem; }
th, td { padding: .35rem 1rem .35rem 0; border-bottom: 1px solid var(--line); vertical-align: middle;
  white-space: nowrap; }
tr:last-child td { border-bottom: 0; }
details td:last-child { white-space: normal; overflow-wrap: anywhere; }
.bar { display: inline-block; width: 9rem; height: .7rem; margin-right: .6rem; background: var(--track);
  border-radius: .35rem; overflow: hidden; vertical-align: middle; }
.bar i { display: block; height: 100%; background: var(--bar); } .bar.over i { background: var(--over); }
b { font-weight: 600; } code { font-size: .85em; }
summary { cursor: pointer; font-weight: 600; }
.words { display: inline-block; min-width: 22rem; white-space: normal; }
.state { padding: .05rem .5rem; border-radius: .6rem; background: var(--track); font-size: .85rem; }
.state.ran { color: var(--bar); } .state.failed { color: var(--over); font-weight: 700; }
@media print { :root { --paper: #fff; --card: #fff; --ink: #000; --soft: #444; --line: #bbb; --bar: #2f7d4f;
  --track: #ddd; } main { max-width: none; padding: 0; } section, figure { break-inside: avoid; }
  .bar, .bar i { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""
