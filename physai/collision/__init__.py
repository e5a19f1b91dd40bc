"""Whether a robot touches itself or what stands around it: capsules, their distances, and their form in files."""

from physai.collision.capsules import Box, Capsule
from physai.collision.frames import Kinematics, Motions
from physai.collision.model import CollisionModel

__all__ = ["Box", "Capsule", "CollisionModel", "Kinematics", "Motions"]
