"""An arm that lifts on request, offers an action, and publishes its temperature.

Run it, and ask it from another terminal:

    python3 arm.py
    fipa request arm_1 crate
    fipa do arm_1 move x=1.5
    fipa subscribe arm_1 temperature
"""

import asyncio

import fipa


# ANCHOR: serve
def serve(arm: fipa.Agent) -> None:
    @arm.serve("fipa-request")
    async def lift(task: fipa.Task) -> str:
        if task.letter.text == "house":
            raise fipa.Refuse("too heavy")
        await task.agree()
        await asyncio.sleep(0.1)
        return f"lifted {task.letter.text}"
    # ANCHOR_END: serve

    # ANCHOR: action
    @arm.action
    async def move(goal: fipa.Goal, x: float, steps: int = 10) -> float:
        """Moves along x."""
        for step in range(steps):
            goal.progress(step / steps, note=f"at {x * step / steps:.2f} m")
            await asyncio.sleep(0.1)
        return x
    # ANCHOR_END: action


# ANCHOR: main
async def main() -> None:
    with fipa.Domain() as domain:
        arm = await domain.register("arm_1", type="arm")
        serve(arm)
        print("serving as arm_1; end it with Ctrl-C")
        with arm.publisher("temperature", latched=1) as temperature:
            degrees = 20.0
            while True:
                await temperature.publish(f"{degrees:.1f}")
                degrees += 0.1
                await asyncio.sleep(1)


if __name__ == "__main__":
    try:
        asyncio.run(main())
    except KeyboardInterrupt:
        pass
# ANCHOR_END: main
