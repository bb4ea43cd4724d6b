"""What accuracy costs in time: one measure a stage, with knob, reference and error."""
