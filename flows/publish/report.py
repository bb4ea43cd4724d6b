"""Render reports and pages from templates, each as one file without external resources.

All text is escaped here: markup, and characters that change the direction of text.
"""

from __future__ import annotations

import base64
import hashlib
import posixpath
import shlex
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup

from spectralzoom.flows.publish.field_map import FieldMap
from spectralzoom.flows.publish.quicklook import data_address
from spectralzoom.flows.publish.receipt import Receipt
from spectralzoom.flows.publish.receipt_table import finding_rows, format_reference, headline, saving_rows
from spectralzoom.flows.publish.scores import error_matrix, format_false_classes, warnings_of
from spectralzoom.flows.terminal.figures import format_percent, format_points
from spectralzoom.pipeline.errors import visible
from spectralzoom.storage.addresses import split_variable
from spectralzoom.storage.runs import LINE_PRODUCTS

LEAFLET = "vendor/leaflet-1.9.4"  # leafletjs.com, BSD-2-Clause: unchanged from npm's registry
MAP_SCRIPTS = (f"{LEAFLET}/leaflet.js", "scripts/field_map.js")
_MARKDOWN = "\\`*_{}[]<>#|"


@cache
def part(name: str) -> str:
    """Return a file of this folder for a page, without lines that refer to other files."""
    text = files("spectralzoom.flows.publish").joinpath(name).read_text(encoding="utf-8").replace("\r\n", "\n")
    elsewhere = "url(" if name.endswith(".css") else "//# sourceMappingURL="  # unused pictures; source maps
    return "\n".join(line for line in text.split("\n") if elsewhere not in line)


def policy() -> str:
    """Return the content security policy of a page: only the map's scripts run, and nothing is loaded."""
    hashes = (base64.b64encode(hashlib.sha256(part(name).encode()).digest()).decode() for name in MAP_SCRIPTS)
    allowed = " ".join(f"'sha256-{one}'" for one in hashes)
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}; "
        "base-uri 'none'; form-action 'none'"
    )


def render_markdown(template: str, **facts: Any) -> str:
    """Render a Markdown template; text that is no `Markup` is escaped."""
    return visible(_environment(markdown=True).get_template(template).render(facts))


@cache
def _environment(*, markdown: bool) -> Environment:
    found = Environment(
        loader=PackageLoader("spectralzoom.flows.publish", "templates"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=not markdown,
        finalize=_plain if markdown else None,
    )
    found.filters |= {
        "percent": format_percent,
        "points": format_points,
        "data": lambda content: htmlsafe_json_dumps(content, separators=(",", ":")),  # which cannot end its tag
    }
    found.globals["part"] = lambda name: Markup(part(name))
    return found


def _plain(value: object) -> object:
    """Return text escaped for Markdown."""
    if isinstance(value, Markup):
        return value
    return "".join(f"\\{letter}" if letter in _MARKDOWN else letter for letter in visible(str(value)))


def render_report(receipt: Receipt, quicklook: bytes, field: FieldMap) -> str:
    """Return the report as HTML; the same receipt, picture and map give the same bytes."""
    scene = split_variable(receipt["settings"]["scene"])[0].name
    accuracy = receipt.get("accuracy")
    page = _environment(markdown=False).get_template("report.html")
    text = page.render(
        policy=policy(),
        scripts=Markup("\n").join(Markup("<script>{}</script>").format(Markup(part(name))) for name in MAP_SCRIPTS),
        title=receipt["survey"],
        warnings=warnings_of(receipt),
        lead=headline(receipt),
        about=f"{scene}, source {receipt['source']}, seed {receipt['seed']}, "
        + (f"acquired {receipt['acquired']}, " if "acquired" in receipt else "")
        + f"finished {receipt['finished']}",
        links={  # without raw lines, which may be cleared, and the report itself
            name.replace("_", " "): quote(posixpath.relpath(address, _run_folder(receipt)))
            for name, address in receipt["products"].items()
            if name not in (*LINE_PRODUCTS, "report.html")
        },
        export=shlex.join(["spectralzoom", "export", receipt["settings"]["out"], *_run_folder(receipt).split("/")[1:]]),
        field=field,
        leaflet=LEAFLET,
        quicklook=data_address(quicklook),
        savings=saving_rows(receipt),
        reference=format_reference(receipt),
        findings=finding_rows(receipt),
        accuracy=accuracy,
        control=receipt.get("control"),
        error_matrix=None if accuracy is None else error_matrix(accuracy),
        false_classes="" if accuracy is None else format_false_classes(accuracy),
    )
    return visible(text)


def _run_folder(receipt: Receipt) -> str:
    products: Mapping[str, str] = receipt["products"]
    return next(posixpath.dirname(one) for one in products.values() if one.startswith("runs/"))
