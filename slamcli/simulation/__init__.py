"""The simulator: unbounded floors, a camera without aliasing, drives with exact ground truth."""
