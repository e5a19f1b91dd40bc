"""The Python of the page on ROS 2 sends a goal."""

import threading

from geometry_msgs.msg import PointStamped

from tests.docs.blocks import blocks
from tests.waiting import wait_for


def test_the_goal_of_the_page_arrives(peer, domain, monkeypatch):
    (block,) = [block for block in blocks("python") if "rclpy.init()" in block.text]
    heard = []
    peer.listen(PointStamped, "/inference_node/goal", heard, 1)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    assert threading.current_thread() is threading.main_thread()  # rclpy.init() handles signals
    exec(block.text, {})
    goal = wait_for(lambda: heard, what="the goal")[0][1]
    assert (goal.header.frame_id, goal.point.x, goal.point.y) == ("base", 0.3, -0.2)
