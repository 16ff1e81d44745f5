"""The bridge between ROS 2 and agents: the command `fipa-ros2`."""
