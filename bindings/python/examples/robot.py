"""A robot that drives a winding way, and publishes its pose 20 times per second.

Run it, and see where it is from another terminal (plot_pose.py needs matplotlib):

    python3 robot.py
    fipa subscribe robot pose
    python3 plot_pose.py
"""

import asyncio
import json
import math

import fipa

#: Time between two poses in seconds.
STEP = 0.05


# ANCHOR: robot
async def drive(pose: fipa.Publisher) -> None:
    x, y, time = 0.0, 0.0, 0.0
    while True:
        heading = 1.2 * math.sin(time) + 0.05 * time
        await pose.publish(json.dumps({"x": x, "y": y, "heading": heading}))
        await asyncio.sleep(STEP)
        # It drives 0.5 m per second.
        x += 0.5 * STEP * math.cos(heading)
        y += 0.5 * STEP * math.sin(heading)
        time += STEP


async def main() -> None:
    with fipa.Domain() as domain:
        robot = await domain.register("robot")
        with robot.publisher("pose", media_type="application/json", rate=1 / STEP) as pose:
            print("publishing the pose of robot; end it with Ctrl-C")
            await drive(pose)
            # ANCHOR_END: robot


if __name__ == "__main__":
    try:
        asyncio.run(main())
    except KeyboardInterrupt:
        pass
