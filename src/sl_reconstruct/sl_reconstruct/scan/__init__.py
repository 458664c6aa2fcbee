"""One scan as a flow of steps, without ROS."""
