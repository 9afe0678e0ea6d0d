"""Raw mode: the pose straight from GPS and IMU, ignoring odometry. Pure."""
