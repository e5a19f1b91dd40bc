"""Where a policy stops to work: maps over two parameters, and the break values of each alone."""
