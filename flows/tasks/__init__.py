"""The survey: its context, its stages from a coarse look to a class map, and the engines that run them."""
