"""The inference node, with a controller that raises when the arm has moved for 20 ticks."""

from physai.deploy import Controller
from physai.ros import inference_node


class RaisingController(Controller):
    moved = 0

    def update(self, *args, **kwargs):
        command = super().update(*args, **kwargs)
        self.moved += command.value is not None and command.value.any()
        if self.moved > 20:
            raise RuntimeError("the controller broke")
        return command


def main() -> int:
    inference_node.Controller = RaisingController
    return inference_node.main()
