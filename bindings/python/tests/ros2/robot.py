"""A robot of ROS as its makers write it, without a word of agents: a publisher, a service and an action server.

    robot.py NAMESPACE [LOG]

The log has a line for each step of a goal: its id and what happened.
"""

import sys
import threading
import time

import rclpy
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int64, String
from test_msgs.action import Fibonacci
from test_msgs.srv import BasicTypes

#: Time between two numbers in seconds.
STEP = 0.05


class Robot(Node):
    def __init__(self, namespace: str, log: str | None) -> None:
        super().__init__("robot", namespace=namespace)
        self.log = open(log, "a", buffering=1) if log else None
        self.lock = threading.Lock()
        self.count = 0
        self.counter = self.create_publisher(Int64, "count", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.map = self.create_publisher(String, "map", latched)
        self.map.publish(String(data="the map"))
        self.create_timer(0.05, self.tick)
        self.create_service(BasicTypes, "double", self.double)
        self.heard = []
        self.create_subscription(String, "heard", lambda message: self.write("heard", message.data), 10)
        self.server = ActionServer(
            self,
            Fibonacci,
            "count_up",
            execute_callback=self.count_up,
            goal_callback=lambda goal: GoalResponse.REJECT if goal.order < 0 else GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def write(self, name: str, what: str) -> None:
        if self.log:
            with self.lock:
                self.log.write(f"{name} {what}\n")

    def tick(self) -> None:
        self.count += 1
        self.counter.publish(Int64(data=2**60 + self.count))

    def double(self, request: BasicTypes.Request, response: BasicTypes.Response) -> BasicTypes.Response:
        response.int64_value = request.int64_value * 2
        response.string_value = request.string_value * 2
        response.float64_value = request.float64_value
        return response

    def count_up(self, goal) -> Fibonacci.Result:
        name = bytes(goal.goal_id.uuid).hex()
        self.write(name, "started")
        numbers = [0, 1]
        while len(numbers) < goal.request.order:
            if goal.is_cancel_requested:
                self.write(name, "canceled")
                goal.canceled()
                return Fibonacci.Result(sequence=numbers)
            time.sleep(STEP)
            numbers.append((numbers[-1] + numbers[-2]) % 1_000_000)
            goal.publish_feedback(Fibonacci.Feedback(sequence=numbers))
        if goal.request.order == 13:
            self.write(name, "aborted")
            goal.abort()
        else:
            self.write(name, "succeeded")
            goal.succeed()
        return Fibonacci.Result(sequence=numbers)


def main() -> None:
    rclpy.init()
    robot = Robot(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None)
    executor = MultiThreadedExecutor(8)
    executor.add_node(robot)
    print("ready", flush=True)
    try:
        executor.spin()
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
