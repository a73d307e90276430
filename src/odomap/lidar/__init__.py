"""LiDAR: clouds of points, how they are kept, and how one is laid onto another."""
