"""FrameCache that show why: each takes what a stage made and returns pixels."""
