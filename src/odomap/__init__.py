"""odomap: SLAM in Python for cameras, LiDAR and IMU."""

__version__ = "0.1.0"
