"""Metric bird's-eye maps of the floor, and the robot's poses on it, from a camera's frames."""

from __future__ import annotations

__version__ = "0.1.0"
