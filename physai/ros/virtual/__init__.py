"""What the virtual robot is made of: its arm, and its faults; no ROS in here."""
