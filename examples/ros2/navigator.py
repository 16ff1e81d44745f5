"""A simulated robot of ROS 2 in a corridor, as its makers write it: it has only rclpy, and knows nothing of agents.

    python3 navigator.py --ros-args -r __ns:=/crex -p x:=2.0

A real robot offers nav2_msgs/action/NavigateToPose, and publishes a pose of geometry_msgs. The types here need no Nav2:
a goal of Fibonacci stands for a place, in decimeters from the beginning of the corridor.
"""

import time

import rclpy
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Float64
from test_msgs.action import Fibonacci

#: Length of the corridor in meters.
LENGTH = 12.0

#: Speed in meters per second.
SPEED = 1.0

#: Time between two poses in seconds.
STEP = 0.2


class Navigator(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("navigator")
        self._x = float(self.declare_parameter("x", 0.0).value)
        self._is_driving = False
        self._pose = self.create_publisher(Float64, "pose", 10)
        self.create_timer(STEP, lambda: self._pose.publish(Float64(data=self._x)))
        self._server = ActionServer(
            self,
            Fibonacci,
            "navigate",
            execute_callback=self._drive,
            goal_callback=self._decide,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def _decide(self, goal: Fibonacci.Goal) -> GoalResponse:
        is_inside = 0 <= goal.order <= 10 * LENGTH
        return GoalResponse.ACCEPT if is_inside and not self._is_driving else GoalResponse.REJECT

    def _drive(self, handle) -> Fibonacci.Result:  # type: ignore[no-untyped-def]
        target = handle.request.order / 10
        self._is_driving = True
        try:
            while abs(target - self._x) > 1e-6:
                if handle.is_cancel_requested:
                    handle.canceled()
                    break
                time.sleep(STEP)
                self._x += max(-SPEED * STEP, min(SPEED * STEP, target - self._x))
                handle.publish_feedback(Fibonacci.Feedback(sequence=[round(10 * self._x)]))
            else:
                handle.succeed()
        finally:
            self._is_driving = False
        return Fibonacci.Result(sequence=[round(10 * self._x)])


def main() -> None:
    rclpy.init()
    executor = MultiThreadedExecutor()
    executor.add_node(Navigator())
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
