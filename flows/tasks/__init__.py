"""The survey: its context, its stages from a coarse pass to a class map, and the engines that run them."""
