"""Messages that wake nobody: they wait until whoever needs them looks, such as a tick that looks at each period."""

from collections.abc import Iterator
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.subscription import Subscription


class Unawaited(CallbackGroup):
    """A group of subscriptions that no executor waits for; their messages are there for :func:`waiting`.

    To be woken by a message costs a node more than to take it, most of all where many nodes share a core.
    """

    def can_execute(self, entity: Any) -> bool:
        """No executor may call it."""
        return False


def waiting(subscription: Subscription) -> Iterator[tuple[Any, dict[str, int]]]:
    """Take the messages that have come, with what rclpy says of each, at most as many as its queue holds.

    A flood must not keep whoever asks waiting for its end.
    """
    with subscription.handle:
        for _ in range(subscription.qos_profile.depth):
            if not (taken := subscription.handle.take_message(subscription.msg_type, False)):
                return
            yield taken


def nobody(_: Any) -> None:
    """Be the callback of a subscription that has none."""
