"""Which trigger, image and pose belong together. No ROS here: the same live and offline."""
