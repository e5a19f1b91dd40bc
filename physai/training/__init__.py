"""Training: the loop, evaluation, checkpoints, logs."""
