"""What accuracy costs in time: one module a choice, each with knob, reference and error measure."""
