"""The world: the only rooms that know a path or an open file."""
