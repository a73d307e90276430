"""Pure mathematics of pose and camera."""
