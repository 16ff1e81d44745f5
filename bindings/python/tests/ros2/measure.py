"""Measures the bridge in one run: requests beside those of rclpy and of agents, and images of 1 MB.

    measure.py [REQUESTS] [SECONDS]
"""

import os
import statistics
import sys
import time
from collections.abc import Callable

import rclpy
from rclpy.serialization import deserialize_message
from support import HERE, LONG, Bridge, Site, until
from test_msgs.msg import UnboundedSequences
from test_msgs.srv import BasicTypes

import fipa

MAPPING = """
services = ["/crex/double"]
topics = ["/crex/image"]
[settings."/crex/image"]
content = "cdr"
"""
RATE = 30
CONTENT = "(double :int64_value 21)"


def main() -> None:
    requests = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    seconds = int(sys.argv[2]) if len(sys.argv) > 2 else 60
    site = Site()
    try:
        site.robot("crex")
        bridge = site.bridge(MAPPING)
        site.start("fipa", "echo", "echo")
        until(lambda: bridge.has_logged("/crex/double is "), "the mapping")
        with fipa.Domain() as domain:
            own = domain.register("measure").wait()
            measure_requests(own, requests)
            measure_images(site, own, bridge, seconds)
    finally:
        site.close()


def measure_requests(own: fipa.Agent, requests: int) -> None:
    rclpy.init()
    node = rclpy.create_node("measure")
    client = node.create_client(BasicTypes, "/crex/double")
    client.wait_for_service(LONG)

    def by_ros() -> None:
        rclpy.spin_until_future_complete(node, client.call_async(BasicTypes.Request(int64_value=21)))

    def between_agents() -> None:
        own.request(fipa.Message("request", "echo", CONTENT)).wait(LONG)

    def by_bridge() -> None:
        own.request(fipa.Message("request", "crex", CONTENT)).wait(LONG)

    times: dict[Callable[[], None], list[float]] = {by_ros: [], between_agents: [], by_bridge: []}
    for _ in range(requests):
        for work, taken in times.items():
            begin = time.perf_counter()
            work()
            taken.append((time.perf_counter() - begin) * 1e6)
    ros, agents, bridge = (statistics.median(taken) for taken in times.values())
    print(f"a request of rclpy: {ros:.0f} us; of agents: {agents:.0f} us; through the bridge: {bridge:.0f} us")
    bound = 2 * ros + agents
    print(f"bound, twice rclpy and one of agents: {bound:.0f} us; ratio {bridge / bound:.2f}, at most 1")
    node.destroy_node()
    rclpy.shutdown()


def processor_time(process: int) -> float:
    with open(f"/proc/{process}/stat") as stat:
        fields = stat.read().rsplit(") ", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure_images(site: Site, own: fipa.Agent, bridge: Bridge, seconds: int) -> None:
    count, process = RATE * seconds, bridge.process.pid
    site.start(sys.executable, str(HERE / "camera.py"), "crex", str(RATE), str(count))
    until(lambda: bridge.has_logged("/crex/image is "), "the mapping")
    letters = own.subscribe("crex", "image", keep="all")
    begun, used = time.monotonic(), processor_time(process)
    numbers = [-1]
    while numbers[-1] < count - 1:
        with letters.next().wait(LONG) as letter:
            numbers.append(deserialize_message(bytes(letter), UnboundedSequences).int32_values[0])
    used, taken = processor_time(process) - used, time.monotonic() - begun
    lost = count - numbers[1] - len(set(numbers[1:]))
    print(f"{count} images of 1 MB at {RATE} Hz: {lost} lost, {used / taken:.1%} of a core, at most 25 %")


if __name__ == "__main__":
    main()
