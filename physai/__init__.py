"""physai: the shortest trustworthy way from a simulated robot arm to a policy on a ROS 2 robot."""
