"""Training weights: labelled scenes in, one file of weights with its record out."""
