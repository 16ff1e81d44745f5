"""A carrier in Python, which bids its distance from a crate. Usage: bid.py NAME X Y"""

import asyncio
import json
import math
import sys

import fipa

#: A carrier refuses a crate that is farther away.
REACH = 6.0


async def main(name: str, x: float, y: float) -> None:
    with fipa.Domain() as domain:
        carrier = await domain.register(name)

        @carrier.serve("fipa-contract-net")
        async def bid(task: fipa.Task) -> str | None:
            crate = json.loads(task.letter.text)
            distance = math.hypot(crate["x"] - x, crate["y"] - y)
            if distance > REACH:
                print("refused", flush=True)
                raise fipa.Refuse("too far")
            accepted = await task.propose(json.dumps({"distance": distance}))
            print("accepted" if accepted else "rejected", flush=True)
            return f"carried by {name}" if accepted else None

        print("ready", flush=True)
        await asyncio.Event().wait()


asyncio.run(main(sys.argv[1], float(sys.argv[2]), float(sys.argv[3])))
