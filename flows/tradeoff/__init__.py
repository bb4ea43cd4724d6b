"""Trade-offs of accuracy against time: one measure a stage, with knob, reference and error."""
