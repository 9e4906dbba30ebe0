"""SLAM: frames in, poses and a map out."""
