"""Work on an archive's runs: what it holds, plans, comparisons, reprocessing, data in and products out."""
