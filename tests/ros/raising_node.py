"""The inference node, with a controller that raises while the arm moves, once a goal has come to a moving arm."""

from physai.deploy import Controller
from physai.ros import inference_node


class RaisingController(Controller):
    moved, moving, told = False, False, False

    def update(self, now, joint_state=None, goal=None, interlocks=()):
        # The tick before may have been a late one, in which the arm stood: then it raises at the next that moved it.
        self.told = self.told or (goal is not None and self.moved)
        if self.told and self.moving:
            raise RuntimeError("the controller broke")
        command = super().update(now, joint_state, goal, interlocks)
        self.moving = bool(command.value is not None and command.value.any())
        self.moved = self.moved or self.moving
        return command


def main() -> int:
    inference_node.make_controller = RaisingController
    return inference_node.main()
