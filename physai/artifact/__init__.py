"""From a trained policy to a file that a robot can trust."""

from physai.artifact.export import FILES, export_policy
from physai.artifact.module import DeployablePolicy

__all__ = ["FILES", "DeployablePolicy", "export_policy"]
