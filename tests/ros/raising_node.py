"""The inference node, with a controller that raises at a goal that comes while the arm moves."""

from physai.deploy import Controller
from physai.ros import inference_node


class RaisingController(Controller):
    moving = False

    def update(self, now, joint_state=None, goal=None, interlocks=()):
        if goal is not None and self.moving:
            raise RuntimeError("the controller broke")
        command = super().update(now, joint_state, goal, interlocks)
        self.moving = command.value is not None and command.value.any()
        return command


def main() -> int:
    inference_node.Controller = RaisingController
    return inference_node.main()
