"""The camera over a flat floor: calibration, lens, projection, footprint and resolution."""
