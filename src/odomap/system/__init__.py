"""What decides: tracking, odometry, workers, configuration."""
