"""A camera of ROS: publishes images of 1 MB, as its makers write it.

    camera.py NAMESPACE RATE COUNT
"""

import sys
import time

import rclpy
from test_msgs.msg import UnboundedSequences


def main() -> None:
    namespace, rate, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
    rclpy.init()
    node = rclpy.create_node("camera", namespace=namespace)
    publisher = node.create_publisher(UnboundedSequences, "image", 10)
    image = UnboundedSequences(uint8_values=bytes(1_000_000))
    while publisher.get_subscription_count() == 0:
        time.sleep(0.1)
    time.sleep(1.0)
    begin = time.monotonic()
    for number in range(count):
        image.int32_values = [number]
        publisher.publish(image)
        time.sleep(max(0.0, begin + (number + 1) / rate - time.monotonic()))
    # Until the last image has left.
    time.sleep(2.0)


if __name__ == "__main__":
    main()
