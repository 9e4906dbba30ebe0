"""The back end: the pose graph, and what optimises it."""
