"""What a page carries with it instead of loading it: own scripts, a library for maps, and who may run in the page."""

from __future__ import annotations

import hashlib
from base64 import b64encode
from functools import cache
from importlib.resources import files

from markupsafe import Markup

LEAFLET = "vendor/leaflet-1.9.4"  # leafletjs.com, BSD-2-Clause: unchanged from npm's registry
SHA256 = {
    f"{LEAFLET}/leaflet.js": "db49d009c841f5ca34a888c96511ae936fd9f5533e90d8b2c4d57596f4e5641a",
    f"{LEAFLET}/leaflet.css": "a7837102824184820dfa198d1ebcd109ff6d0ff9a2672a074b9a1b4d147d04c6",
    f"{LEAFLET}/LICENSE": "53e8dc25862014e4324741ca18fbe3611e11d42ef69f59f86ea8c5389647d4cb",
}


@cache
def part(name: str) -> str:
    """A file beside this module as it stands in a page: without what would point at files elsewhere."""
    text = files("flows.publish").joinpath(name).read_text(encoding="utf-8").replace("\r\n", "\n")
    elsewhere = "url(" if name.endswith(".css") else "//# sourceMappingURL="  # pictures that no page uses; a debugger's
    return "\n".join(line for line in text.split("\n") if elsewhere not in line)


def scripts(names: tuple[str, ...]) -> Markup:
    """Scripts in their order, as the tags that hold them."""
    return Markup("\n").join(Markup("<script>{}</script>").format(Markup(part(name))) for name in names)


def policy(names: tuple[str, ...]) -> str:
    """The content security policy of a page with these scripts: they alone run, and nothing is loaded from anywhere."""
    sources = [f"'sha256-{b64encode(hashlib.sha256(part(name).encode()).digest()).decode()}'" for name in names]
    allowed = " ".join(sources) or "'none'"
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}; "
        "base-uri 'none'; form-action 'none'"
    )
