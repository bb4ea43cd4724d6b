"""From raw lines to pixels of the scene grid: calibration, geolocation grid, resampling, mosaic."""
