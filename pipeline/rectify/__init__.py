"""Rectify raw lines to pixels of the scene grid: geolocation grid, registration, resampling, mosaic."""
