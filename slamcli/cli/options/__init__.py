"""The command line's options, by subject; each is defined once, and none of them loads numpy."""
