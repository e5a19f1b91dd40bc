"""A robot behind topics as a physics and as a Gymnasium env, for programs that are no node."""
