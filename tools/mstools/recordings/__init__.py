"""Recordings as input: ROS bags, answers from LCM logs."""
