"""From a trained policy to a file that a robot can trust."""

from physai.artifact.export import FILES, export_policy

__all__ = ["FILES", "export_policy"]
