"""From raw lines to pixels of the scene grid: calibration, lookup, resampling, mosaic."""
