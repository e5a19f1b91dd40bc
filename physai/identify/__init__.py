"""The robot as it is: the parameters with which a simulated one moves as a recorded one did."""
