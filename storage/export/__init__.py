"""Products for other programs: GeoTIFF, ENVI, STAC."""
