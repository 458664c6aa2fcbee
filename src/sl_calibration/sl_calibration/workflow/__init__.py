"""A calibration from its request to its verdict and folder, without ROS."""
