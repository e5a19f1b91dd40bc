"""ROS 2 nodes over :mod:`physai.deploy`: they need the ``ros`` extra, or a sourced ROS 2 Jazzy."""
