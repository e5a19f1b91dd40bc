"""What calls the callbacks of nodes, in one thread, and with little work of its own between them."""

import contextlib
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy import executors
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer

_LOOK = 1.0  # s between two looks for what the middleware has to say: that is for the log alone


class Executor(executors.Executor):
    """Waits for messages, timers and requests of nodes, and calls whoever they are for.

    rclpy's single-threaded executor gathers all that it waits for anew before each callback, and again after it, which
    costs more than most callbacks do. This one does so when something was made or destroyed, and after a wait it calls
    all who are ready: messages come first, so that a timer knows the newest. Callbacks are plain functions, there are
    no tasks and no actions, and things are made and destroyed in the thread that spins.

    Args:
        nodes: Whose callbacks they are; all of one context.
        ends: Whether nobody is to be called any more, also of those who are ready.
    """

    def __init__(self, nodes: Sequence[Node], ends: Callable[[], bool] = lambda: False) -> None:
        super().__init__(context=nodes[0].context)
        self._ends = ends
        self._in_order = nodes
        self._changed = True
        self._looked = time.monotonic()
        for node in nodes:
            self.add_node(node)

    def wake(self) -> None:
        """Gather anew what there is to wait for; rclpy calls this when something was made or destroyed."""
        self._changed = True
        super().wake()

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """There are no tasks: nobody would run them."""
        raise NotImplementedError

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait until something is ready, for so long at most, and call whoever it is for.

        Raises:
            ExternalShutdownException: If ROS has been shut down.
        """
        guard, context = self._guard, self._context.handle
        if self._is_shutdown or guard is None or context is None:
            return
        if not self._context.ok():
            raise executors.ExternalShutdownException
        if self._changed:
            self._changed = False
            self._gather()
        waits = self._waits
        waits.clear_entities()
        with guard.handle, context:  # another thread may shut down meanwhile
            waits.add_guard_condition(guard.handle)
            for add, handle in self._awaited:
                add(handle)
            waits.wait(-1 if timeout_sec is None else int(timeout_sec * 1e9))
        if not self._context.ok():
            raise executors.ExternalShutdownException
        for kind, works in self._works.items():
            for pointer in waits.get_ready_entities(kind):
                if self._is_shutdown or self._ends():
                    return
                if pointer in works:
                    _work(*works[pointer])
        if time.monotonic() - self._looked > _LOOK:
            self._looked = time.monotonic()
            self._look()

    def _gather(self) -> None:
        found: dict[str, list[Any]] = {
            kind: [
                entity
                for node in self._in_order
                for entity in getattr(node, entities)
                if entity.callback_group.can_execute(entity)
            ]
            for kind, entities in (
                ("guard_condition", "guards"),
                ("subscription", "subscriptions"),
                ("timer", "timers"),
                ("client", "clients"),
                ("service", "services"),
            )
        }
        guards, subscriptions, timers, clients, services = map(len, found.values())
        sizes = subscriptions, guards + 1, timers, clients, services, 0
        self._waits = waits = rclpy_implementation.WaitSet(*sizes, self._context.handle)
        self._awaited, self._works = [], {}
        for kind, entities in found.items():
            add = getattr(waits, f"add_{kind}")
            self._awaited += [(add, entity.handle) for entity in entities]
            self._works[kind] = {entity.handle.pointer: (_TAKES[kind], entity) for entity in entities}

    def _look(self) -> None:
        """Have said what the middleware knows, such as that a publisher offers another quality of service."""
        events = [event for node in self._in_order for event in node.waitables]
        waits = rclpy_implementation.WaitSet(0, 0, 0, 0, 0, len(events), self._context.handle)
        waits.clear_entities()
        for event in events:
            event.add_to_wait_set(waits)
        waits.wait(0)
        for event in events:
            if event.is_ready(waits):
                with contextlib.suppress(StopIteration):  # how a coroutine ends
                    event.execute(event.take_data()).send(None)


def _work(take: Callable[[Any], Callable[[], object] | None], entity: Any) -> None:
    try:
        with entity.handle:
            call = take(entity)
    except InvalidHandle:  # who was called before has destroyed it
        return
    if call is not None:
        call()


def _take_guard(guard: GuardCondition) -> Callable[[], object]:
    return guard.callback


def _take_message(subscription: Subscription) -> Callable[[], object] | None:
    taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    if taken is None:
        return None
    alone = subscription._callback_type is Subscription.CallbackType.MessageOnly
    return partial(subscription.callback, *taken[:1] if alone else taken)


def _take_timer(timer: Timer) -> Callable[[], object] | None:
    if not timer.handle.is_timer_ready():  # who was called before has cancelled it
        return None
    timer.handle.call_timer()
    return timer.callback


def _take_answer(client: Any) -> Callable[[], object] | None:
    header, response = client.handle.take_response(client.srv_type.Response)
    if header is None:
        return None
    try:
        return partial(client.get_pending_request(header.request_id.sequence_number).set_result, response)
    except KeyError:  # nobody waits for it any more
        return None


def _take_request(service: Any) -> Callable[[], object] | None:
    request, header = service.handle.service_take_request(service.srv_type.Request)
    if header is None:
        return None
    return lambda: service.send_response(service.callback(request, service.srv_type.Response()), header)


_TAKES: dict[str, Callable[[Any], Callable[[], object] | None]] = {
    "guard_condition": _take_guard,
    "subscription": _take_message,
    "timer": _take_timer,
    "client": _take_answer,
    "service": _take_request,
}
