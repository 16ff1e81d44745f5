"""Agents that bid for robots of ROS 2: a robot of ROS answers no call for proposals, so an agent does it.

    python3 bidder.py crex daisy

Each bidder proposes the way that its robot would have to drive. The one that gets the work reserves the passage, and
drives its robot.
"""

import asyncio
import contextlib
import json
import sys

import fipa


# ANCHOR: pose
async def pose(agent: fipa.Agent, robot: str) -> float:
    """Returns the place of a robot: the next message of its topic in ROS."""
    with agent.subscribe(robot, "pose", timeout=5) as poses:
        async for letter in poses:
            return float(json.loads(letter.text)["data"])
    raise fipa.Refuse(f"{robot} publishes no pose")
    # ANCHOR_END: pose


# ANCHOR: bid
def serve(bidder: fipa.Agent, robot: str) -> None:
    @bidder.serve("fipa-contract-net")
    async def drive(task: fipa.Task) -> str | None:
        place = float(task.letter.text)
        try:
            way = abs(place - await pose(bidder, robot))
        except fipa.Error as error:
            raise fipa.Refuse(str(error)) from None
        if not await task.propose(f"{way:.1f}"):
            return None
        try:
            return f"{await reach(bidder, robot, place):.1f}"
        except fipa.Error as error:
            await task.fail(str(error))
            return None


async def reach(bidder: fipa.Agent, robot: str, place: float) -> float:
    """Has a robot drive to a place, while the passage is its own. Returns the place that it has reached."""
    # The bridge refuses a goal without the fence of this lock.
    async with bidder.lock("passage", timeout=60) as lock:
        goal = bidder.invoke(robot, "navigate", {"order": round(10 * place)}, lock=lock)
        try:
            print(f"{robot} drives:", end="", flush=True)
            async for progress in goal:
                if feedback := progress.get("value"):
                    print(f" {feedback['sequence'][-1] / 10:.1f}", end="", flush=True)
            return float((await goal.result())["sequence"][-1]) / 10
        except asyncio.CancelledError:
            # The dispatcher is gone. The robot stops before the passage is free again.
            goal.cancel()
            with contextlib.suppress(fipa.Error):
                await goal.result()
            raise
        finally:
            print(" m", flush=True)
    # ANCHOR_END: bid


async def main(robots: list[str]) -> None:
    with fipa.Domain() as domain:
        for robot in robots:
            serve(await domain.register(f"{robot}_bidder", type="bidder"), robot)
        print(f"bidding for {', '.join(robots)}; end it with Ctrl-C", flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    try:
        asyncio.run(main(sys.argv[1:]))
    except KeyboardInterrupt:
        pass
