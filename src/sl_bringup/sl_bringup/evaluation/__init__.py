"""Recordings turned into clouds, calibrations and comparisons, without ROS."""
