"""From raw numbers to scene values: dark and white frames, detector pixels, the light of each sweep."""
