"""Recordings as files; no ROS in here."""
