"""Agents for ROS: clients of rclpy, without a word of agents, reach actions, services and topics of agents."""

import subprocess
import threading
import time
import unittest

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from std_msgs.msg import Float64, String
from support import LONG, Site, until
from test_msgs.action import Fibonacci
from test_msgs.srv import BasicTypes

import fipa

MAPPING = """
[agents.arm_1.actions]
count_up = "test_msgs/action/Fibonacci"
[agents.arm_1.services]
lift = "test_msgs/srv/BasicTypes"
[agents.arm_1.topics]
state = "std_msgs/msg/String"
[agents.sensor.topics]
depth = "std_msgs/msg/Float64"
[agents.slow.services]
never = "test_msgs/srv/BasicTypes"
[agents.slow.actions]
never = "test_msgs/action/Fibonacci"
[agents.ear.services]
tell = "test_msgs/srv/BasicTypes"
"""


class Agents(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        cls.site = Site()
        cls.addClassCleanup(cls.site.close)
        cls.domain = fipa.Domain()
        cls.addClassCleanup(cls.domain.close)
        cls.arm = cls.domain.register("arm_1").wait()
        cls.arm.action(count_up)
        cls.arm.serve("fipa-request", lift)
        cls.state = cls.arm.publisher("state", latched=1)
        cls.bridge = cls.site.bridge(MAPPING)
        rclpy.init()
        cls.addClassCleanup(rclpy.shutdown)
        cls.node = rclpy.create_node("client")
        cls.addClassCleanup(cls.node.destroy_node)

    def answer(self, future: "rclpy.task.Future") -> object:
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=LONG)
        self.assertTrue(future.done())
        return future.result()

    def client(self) -> "ActionClient":
        client = ActionClient(self.node, Fibonacci, "/arm_1/count_up")
        self.addCleanup(client.destroy)
        self.assertTrue(client.wait_for_server(LONG))
        return client

    def test_an_action_has_feedback_and_a_result(self) -> None:
        client, seen = self.client(), []
        goal = Fibonacci.Goal(order=6)
        handle = self.answer(client.send_goal_async(goal, lambda it: seen.append(list(it.feedback.sequence))))
        self.assertTrue(handle.accepted)
        response = self.answer(handle.get_result_async())
        self.assertEqual(response.status, GoalStatus.STATUS_SUCCEEDED)
        self.assertEqual(list(response.result.sequence), [0, 1, 1, 2, 3, 5])
        self.assertTrue(seen)

    def test_a_failed_goal_is_aborted_and_a_refused_one_rejected(self) -> None:
        client = self.client()
        handle = self.answer(client.send_goal_async(Fibonacci.Goal(order=-1)))
        response = self.answer(handle.get_result_async())
        self.assertEqual(response.status, GoalStatus.STATUS_ABORTED)
        running = self.answer(client.send_goal_async(Fibonacci.Goal(order=1000)))
        self.assertTrue(running.accepted)
        # The action takes one goal at a time.
        self.assertFalse(self.answer(client.send_goal_async(Fibonacci.Goal(order=3))).accepted)
        self.answer(running.cancel_goal_async())
        response = self.answer(running.get_result_async())
        self.assertEqual(response.status, GoalStatus.STATUS_CANCELED)

    def test_a_service_answers(self) -> None:
        client = self.node.create_client(BasicTypes, "/arm_1/lift")
        self.assertTrue(client.wait_for_service(LONG))
        answer = self.answer(client.call_async(BasicTypes.Request(int64_value=2**60, string_value='a "b"')))
        self.assertEqual((answer.int64_value, answer.string_value), (2**60 + 1, 'a "b"'))

    def test_a_failed_request_has_no_answer(self) -> None:
        client = self.node.create_client(BasicTypes, "/arm_1/lift")
        self.assertTrue(client.wait_for_service(LONG))
        future = client.call_async(BasicTypes.Request(int64_value=-1))
        end = time.monotonic() + LONG
        while not self.bridge.has_logged("no answer") and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        self.assertTrue(self.bridge.has_logged("too low"))
        self.assertFalse(future.done())

    def test_an_agent_that_does_not_answer_delays_no_other(self) -> None:
        slow = self.domain.register("slow").wait()
        self.addCleanup(slow.deregister)
        order = {"name": "order", "type": "integer"}
        goals = slow.goals({"name": "never", "decides": True, "parameters": [order]})
        requests = slow.tasks("fipa-request")
        self.addCleanup(goals.close)
        never = self.node.create_client(BasicTypes, "/slow/never")
        self.assertTrue(never.wait_for_service(LONG))
        action = ActionClient(self.node, Fibonacci, "/slow/never")
        self.addCleanup(action.destroy)
        self.assertTrue(action.wait_for_server(LONG))
        waiting = [never.call_async(BasicTypes.Request()) for _ in range(3)]
        waiting.append(action.send_goal_async(Fibonacci.Goal()))
        for _ in range(20):
            rclpy.spin_once(self.node, timeout_sec=0.01)
        held = [requests.next().wait(LONG), goals.next().wait(LONG)]
        self.test_a_service_answers()
        self.test_an_action_has_feedback_and_a_result()
        self.assertFalse(any(it.done() for it in waiting))
        del held

    def test_a_topic_is_heard(self) -> None:
        heard: list[str] = []
        self.node.create_subscription(String, "/arm_1/state", lambda it: heard.append(it.data), 10)

        def arrives() -> bool:
            self.state.publish(fipa.sl.dumps({"data": "up"})).wait(LONG)
            rclpy.spin_once(self.node, timeout_sec=0.1)
            return bool(heard)

        until(arrives, "the notification")
        self.assertEqual(heard[0], "up")

    def test_the_commands_publish_and_listen_are_agents_for_ros(self) -> None:
        heard: list[float] = []
        self.node.create_subscription(Float64, "/sensor/depth", lambda it: heard.append(it.data), 10)
        self.site.start("fipa", "publish", "sensor", "depth", "(object :data 1.5)", "--rate", "10")
        listening = self.site.start("fipa", "listen", "ear", "--count", "1", stdout=subprocess.PIPE)
        until(lambda: rclpy.spin_once(self.node, timeout_sec=0.1) or heard, "the notification")
        self.assertEqual(heard[0], 1.5)
        client = self.node.create_client(BasicTypes, "/ear/tell")
        self.assertTrue(client.wait_for_service(LONG))
        until(lambda: any(it["name"] == "ear" for it in self.domain.agents()), "the agent")
        client.call_async(BasicTypes.Request(string_value="hello"))
        rclpy.spin_once(self.node, timeout_sec=0.1)
        self.assertIn("(tell ", listening.communicate(timeout=LONG)[0])

    def test_a_wrong_notification_is_dropped_with_a_warning(self) -> None:
        self.state.publish(fipa.sl.dumps({"date": "up"})).wait(LONG)
        until(lambda: self.bridge.has_logged("notifications are dropped, the last because: date"), "the warning")


def count_up(goal: fipa.Goal, order: int) -> dict[str, list[int]]:
    """Counts."""
    if order < 0:
        raise ValueError("a negative order")
    numbers = [0, 1]
    stopped = threading.Event()
    while len(numbers) < order and goal.stop_reason is None:
        stopped.wait(0.05)
        numbers.append((numbers[-1] + numbers[-2]) % 1_000_000)
        if order < 100:
            goal.progress(value={"sequence": numbers})
    return {"sequence": numbers if order < 100 else []}


def lift(task: fipa.Task) -> str:
    request = fipa.sl.loads(task.letter.text)
    if request["int64_value"] < 0:
        raise fipa.Refuse("too low")
    return fipa.sl.dumps({"int64_value": request["int64_value"] + 1, "string_value": request["string_value"]})


if __name__ == "__main__":
    unittest.main()
