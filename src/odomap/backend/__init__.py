"""Least squares over many poses and landmarks; knows arrays, not maps."""
