"""Pose graphs: the problem, a good start, the descent, the proof, and what is false or unsure."""
