"""Raw mode: the pose directly from GPS and IMU, without odometry. Pure."""
