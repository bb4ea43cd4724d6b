"""The QGIS style of each exported image: classes by name, three bands as colours, one band by a ramp."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flows.archive.export_layers import RGB, Layer
from storage.arrays.quicklooks import choose_bands
from storage.export.image_files import value_span
from storage.export.qgis_styles import GREENS, GREYS, write_class_style, write_colour_style, write_ramp_style


def write_layer_style(layer: Layer, image: Path) -> Path:
    """Write the style of a layer beside its image, which is there already; gives its path."""
    path, about = image.with_suffix(".qml"), layer.image
    if about.legend is not None:
        named = zip(about.legend.names, about.legend.colours.tolist(), strict=True)
        write_class_style(path, [(number, name, tuple(colour)) for number, (name, colour) in enumerate(named)])
    elif about.bands == RGB:
        write_colour_style(path, (1, 2, 3), 1, 255)
    elif about.wavelength_nm is not None:
        red_green_blue = [band + 1 for band in choose_bands(np.array(about.wavelength_nm))[0]]
        write_colour_style(path, red_green_blue, *value_span(image, red_green_blue))
    else:
        ramp = GREENS if "index" in about.tags else GREYS
        write_ramp_style(path, *value_span(image, [1]), ramp)
    return path
