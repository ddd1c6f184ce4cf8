"""A robot in ROS 1 that follows a leader."""
