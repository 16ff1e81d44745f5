"""A dispatcher that has the nearest robot drive to a place in the corridor.

    python3 dispatcher.py 6

It asks all bidders (bidder.py) for their way, awards the work to the shortest, and shows the pose of that robot until
the work is done. It needs no ROS: it can run on another host than the robots.
"""

import asyncio
import json
import sys

import fipa


async def show(agent: fipa.Agent, robot: str, place: float) -> None:
    """Shows the pose of a robot on a line of the terminal."""
    with agent.subscribe(robot, "pose") as poses:
        async for letter in poses:
            x = json.loads(letter.text)["data"]
            print(f"\r{robot} is at {x:.1f} m of {place:.1f} m ", end="", flush=True)


# ANCHOR: dispatch
async def dispatch(agent: fipa.Agent, bidders: list[str], place: float) -> None:
    bids = await agent.call_for_proposals(fipa.Message(receivers=bidders, content=f"{place}"), timeout=20)
    for bid in bids.proposals:
        print(f"{bid.sender}: {bid.text} m")
    for refusal in bids.answers["refusals"]:
        print(f"{refusal['agent']} refuses: {refusal['reason']}")
    best = min(bids.proposals, key=lambda bid: float(bid.text), default=None)
    if best is None or best.sender is None:
        sys.exit("no robot can drive")
    showing = asyncio.ensure_future(show(agent, best.sender.removesuffix("_bidder"), place))
    (result,) = (await bids.award(best, timeout=120)).values()
    showing.cancel()
    print()
    if isinstance(result, Exception):
        sys.exit(f"{best.sender}: {result}")
    print(f"{best.sender}: arrived at {result.text} m")
    # ANCHOR_END: dispatch


async def main(place: float) -> None:
    with fipa.Domain() as domain:
        bidders = [found["name"] for found in domain.agents(type="bidder")]
        if not bidders:
            sys.exit("no bidder runs: start bidder.py")
        await dispatch(await domain.register("dispatcher"), bidders, place)


if __name__ == "__main__":
    try:
        asyncio.run(main(float(sys.argv[1])))
    except KeyboardInterrupt:
        pass
