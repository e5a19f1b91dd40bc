"""A search for good values with Optuna, whose trials are ordinary training runs."""
