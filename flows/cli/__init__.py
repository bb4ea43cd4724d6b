"""The verbs of the command line: flags in, one call into the house, an exit code out."""
