"""Error-state Kalman filter: GNSS, IMU, wheels and further sources, each fused at its instant. Pure."""
