"""The executor of the nodes: whom it calls, in which order, and for what it does not wake."""

import threading
import time

import pytest
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Empty, Float64
from std_srvs.srv import Trigger

from physai.ros.node.executor import Executor
from physai.ros.topics import qos
from physai.ros.topics.unawaited import Unawaited, nobody, waiting


class Spun:
    """A node and its executor, in a context of their own."""

    def __init__(self, domain):
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node("spun", context=self.context)
        self.executor = Executor([self.node])

    def until(self, done, seconds=10.0):
        end = time.monotonic() + seconds
        while not done():
            assert time.monotonic() < end
            self.executor.spin_once(0.05)

    def close(self):
        self.executor.shutdown(1.0)
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def spun(domain):
    made = Spun(domain)
    yield made
    made.close()


def test_calls_whoever_a_message_a_timer_a_request_an_answer_and_a_trigger_are_for(spun):
    node, called = spun.node, set()

    def answer(_, response):
        called.add("request")
        response.message = "here"
        return response

    node.create_subscription(Empty, "topic", lambda _: called.add("message"), 1)
    node.create_subscription(Empty, "topic", lambda _, info: called.add(type(info)), 1)
    node.create_service(Trigger, "service", answer)
    node.create_timer(0.01, lambda: called.add("timer"), clock=Clock(clock_type=ClockType.STEADY_TIME))
    guard = node.create_guard_condition(lambda: called.add("trigger"))
    publisher, client = node.create_publisher(Empty, "topic", 1), node.create_client(Trigger, "service")
    spun.until(lambda: publisher.get_subscription_count() == 2 and client.service_is_ready())
    publisher.publish(Empty())
    guard.trigger()
    asked = client.call_async(Trigger.Request())
    asked.add_done_callback(lambda future: called.add(future.result().message))
    spun.until(lambda: called == {"message", dict, "timer", "request", "here", "trigger"})


def test_calls_back_each_of_several_nodes_also_for_what_is_made_later(spun):
    other, called = Node("other", context=spun.context), []
    both = Executor([spun.node, other])
    spun.node.create_subscription(Empty, "topic", lambda _: called.append("first"), 1)
    publisher = spun.node.create_publisher(Empty, "topic", 1)
    both.spin_once(0.0)
    other.create_subscription(Empty, "topic", lambda _: called.append("other"), 1)
    spun.until(lambda: publisher.get_subscription_count() == 2)
    publisher.publish(Empty())
    end = time.monotonic() + 10.0
    while sorted(called) != ["first", "other"]:
        assert time.monotonic() < end, called
        both.spin_once(0.05)
    both.shutdown(1.0)
    other.destroy_node()


def test_messages_come_before_the_timer_that_is_due_with_them(spun):
    node, order = spun.node, []
    node.create_subscription(Empty, "topic", lambda _: order.append("message"), 1)
    publisher = node.create_publisher(Empty, "topic", 1)
    node.create_timer(0.2, lambda: order.append("timer"), clock=Clock(clock_type=ClockType.STEADY_TIME))
    spun.until(publisher.get_subscription_count)
    seen = len(order)
    spun.until(lambda: len(order) > seen)
    order[:] = ["timer"]
    publisher.publish(Empty())
    time.sleep(0.3)
    spun.executor.spin_once(0.0)
    assert order == ["timer", "message", "timer"]


def test_what_one_callback_destroys_is_not_called_and_what_it_makes_is(spun):
    node, heard = spun.node, []
    publisher = node.create_publisher(Float64, "topic", 1)

    def replace(message):
        heard.append(("first", message.data))
        node.destroy_subscription(second)
        node.create_subscription(Float64, "topic", lambda message: heard.append(("third", message.data)), 1)

    first = node.create_subscription(Float64, "topic", replace, 1)
    second = node.create_subscription(Float64, "topic", lambda message: heard.append(("second", message.data)), 1)
    spun.until(lambda: publisher.get_subscription_count() == 2)
    publisher.publish(Float64(data=1.0))
    time.sleep(0.2)
    spun.until(lambda: heard)
    node.destroy_subscription(first)
    spun.until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(Float64(data=2.0))
    spun.until(lambda: len(heard) == 2)
    assert heard == [("first", 1.0), ("third", 2.0)]


def test_an_exception_of_a_callback_reaches_who_spins(spun):
    def fail():
        raise ValueError("mine")

    spun.node.create_timer(0.01, fail, clock=Clock(clock_type=ClockType.STEADY_TIME))
    with pytest.raises(ValueError, match="mine"):
        spun.until(lambda: False)


def test_messages_that_nobody_awaits_wake_nobody_and_are_there_when_somebody_looks(spun):
    node = spun.node
    unawaited = node.create_subscription(Float64, "topic", nobody, 2, callback_group=Unawaited())
    publisher = node.create_publisher(Float64, "topic", 10)
    spun.until(publisher.get_subscription_count)
    spun.executor.spin_once(0.0)
    for number in range(4):
        publisher.publish(Float64(data=float(number)))
    began = time.monotonic()
    spun.executor.spin_once(0.3)
    assert time.monotonic() - began > 0.25
    taken = list(waiting(unawaited))
    assert [message.data for message, _ in taken] == [2.0, 3.0]  # as deep as its queue is
    assert all(0.25 < time.monotonic() - qos.received_at(info) < 5.0 for _, info in taken)  # when they came
    assert list(waiting(unawaited)) == []


def test_another_thread_can_end_it(spun):
    spinning = threading.Thread(target=spun.executor.spin)
    spinning.start()
    time.sleep(0.1)
    spun.executor.shutdown(1.0)
    spinning.join(5.0)
    assert not spinning.is_alive()


def test_the_end_of_ros_ends_it(spun):
    threading.Timer(0.1, spun.context.try_shutdown).start()
    with pytest.raises(ExternalShutdownException):
        spun.until(lambda: False)


def test_a_publisher_that_does_not_fit_is_named_in_the_log(spun, capfd):
    spun.node.create_subscription(Empty, "topic", nobody, qos.LATCHED)
    spun.node.create_publisher(Empty, "topic", qos.SENSOR)
    said = ""

    def told():
        nonlocal said
        said += "".join(capfd.readouterr())
        return "incompatible QoS" in said

    spun.until(told)


def test_it_waits_without_work_of_its_own(spun):
    spun.executor.spin_once(0.0)
    began, used = time.monotonic(), time.thread_time()
    while time.monotonic() - began < 1.0:
        spun.executor.spin_once(0.1)
    assert time.thread_time() - used < 0.1
