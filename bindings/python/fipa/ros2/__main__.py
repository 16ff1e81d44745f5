"""The command `fipa-ros2`."""

from __future__ import annotations

import argparse
import asyncio
import logging
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import fipa
from fipa.ros2 import mapping
from fipa.ros2.mapping import Mapping, WrongMapping

_EXAMPLES = f"""\
examples:
  fipa-ros2 --list > robot.toml       write what could be mapped, then remove what agents must not reach
  fipa-ros2 robot.toml                bridge what the file names
  fipa-ros2 robot.toml --ros-args -p use_sim_time:=true
  fipa do crex navigate order=10      then let the robot crex perform its action /crex/navigate

{mapping.__doc__}"""

_log = logging.getLogger("fipa.ros2")

#: Time for the discovery of ROS before `--list`, in seconds.
_DISCOVERY = 3.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command. Returns its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    # What follows --ros-args is for rclpy.
    split = given.index("--ros-args") if "--ros-args" in given else len(given)
    parser = argparse.ArgumentParser(
        prog="fipa-ros2",
        description="Bridges ROS 2 and agents: what a mapping names. Runs in the environment of the robot, "
        "with its rclpy and its types.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("mapping", nargs="?", type=Path, metavar="FILE", help="the mapping")
    parser.add_argument("--list", action="store_true", help="print a mapping of what the graph of ROS has, and end")
    parser.add_argument("--config", metavar="FILE", help="configuration of the domain [default: as for `fipa`]")
    parser.add_argument("--name", default="ros2", help="name of the agent that acts for ROS [default: ros2]")
    parser.add_argument("-v", "--verbose", action="store_true", help="log more")
    options = parser.parse_args(given[:split])
    if options.list == (options.mapping is not None):
        parser.error("expected a mapping FILE, or --list")
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s")
    logging.getLogger("fipa").setLevel(logging.INFO if options.verbose else logging.WARNING)
    _log.setLevel(logging.DEBUG if options.verbose else logging.INFO)
    try:
        wanted = None if options.list else mapping.read(options.mapping)
    except (WrongMapping, OSError) as error:
        return _failed(error)
    try:
        import rclpy
    except ModuleNotFoundError as error:
        return _failed(f"{error.name} is missing: source ROS 2, for example /opt/ros/kilted/setup.bash")
    _log.debug("rclpy is in %s", rclpy.__path__)
    return asyncio.run(_run(wanted, options.config, options.name, given[split:]))


def _failed(error: object) -> int:
    print(f"fipa-ros2: {error}", file=sys.stderr)
    return 1


async def _run(wanted: Mapping | None, config: str | None, name: str, ros_arguments: Sequence[str]) -> int:
    from fipa.ros2 import graph
    from fipa.ros2.bridge import Bridge
    from fipa.ros2.ros import Ros
    from fipa.ros2.values import UnknownType

    loop = asyncio.get_running_loop()
    ros = Ros(ros_arguments, loop)
    try:
        if wanted is None:
            print(f"Looking at the graph of ROS for {_DISCOVERY:.0f} s", file=sys.stderr)
            await asyncio.sleep(_DISCOVERY)
            print(graph.listing(await ros.call(graph.all_entities, ros.node)), end="")
            return 0
        with fipa.Domain(config) as domain:
            running = loop.create_task(Bridge(ros, domain, wanted, name).run())
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, running.cancel)
            _log.info("the bridge runs; Ctrl-C ends it")
            try:
                await running
            except asyncio.CancelledError:
                _log.info("the bridge has ended")
            return 0
    except (fipa.Error, UnknownType) as error:
        return _failed(error)
    finally:
        # Joins the thread of ROS, whose calls may wait for the loop.
        await asyncio.to_thread(ros.close)


if __name__ == "__main__":
    sys.exit(main())
