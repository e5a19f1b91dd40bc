"""A robot behind topics as a physics, for programs that are no node."""
