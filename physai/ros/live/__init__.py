"""Showing robots as they are now: channels of Foxglove, and a layout for them."""
