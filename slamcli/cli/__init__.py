"""The command line: the one place that knows click; each command calls one function of `run`."""
