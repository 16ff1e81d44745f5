"""A publisher of ROS as its makers write it.

    talker.py NAME PACKAGE/TYPE [best_effort] [lifecycle] [large] [broken]

A lifecycle node reads transitions, such as `activate`, from the standard input.
"""

import importlib
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy


def main() -> None:
    name, kind, *options = sys.argv[1:]
    package, word = kind.split("/")
    message_type = getattr(importlib.import_module(f"{package}.msg"), word)
    reliability = ReliabilityPolicy.BEST_EFFORT if "best_effort" in options else ReliabilityPolicy.RELIABLE
    rclpy.init()
    is_managed = "lifecycle" in options
    node = LifecycleNode("talker") if is_managed else Node("talker")
    publisher = node.create_publisher(message_type, name, QoSProfile(depth=10, reliability=reliability))
    message = message_type()
    if "large" in options:
        message.data = "x" * 2_000_000
    # A text that is longer than the message.
    broken = bytes([0, 1, 0, 0, 0xFF, 0xFF, 0xFF, 0x7F, 0x61, 0x62])
    node.create_timer(0.1, lambda: publisher.publish(broken if "broken" in options else message))
    if is_managed:
        threading.Thread(target=transitions, args=(node,), daemon=True).start()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


def transitions(node: LifecycleNode) -> None:
    for line in sys.stdin:
        getattr(node, f"trigger_{line.strip()}")()


if __name__ == "__main__":
    main()
