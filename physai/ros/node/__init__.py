"""What each node needs whatever it does: how it starts and ends, its parameters, its output, what it remembers."""
