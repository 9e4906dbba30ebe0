"""The camera over the floor: its calibration, its projection both ways, its mounting."""
