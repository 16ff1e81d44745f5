#!/usr/bin/env python3
"""The operator in Python: it asks for a stack of two items on crex. The launcher starts it with its part as JSON."""

import asyncio
import json
import sys
import time
from typing import Any

import fipa

PART = json.loads(sys.argv[1])


def claim(kind: str, **facts: Any) -> None:
    print(json.dumps({"at": time.time_ns() // 1000, "by": PART["name"], "claim": kind, **facts}), flush=True)


async def find(agent: fipa.Agent, service: str, number: int) -> list[dict[str, Any]]:
    """Waits until this number of agents has a service."""
    while len(found := await agent.search_services(service)) < number:
        await asyncio.sleep(0.1)
    claim("found", service=service, agents=[one["name"] for one in found])
    return found


async def allocate(agent: fipa.Agent, robots: list[str], items: list[dict[str, Any]]) -> dict[str, str]:
    """Has each item fetched by one robot, so that the sum of the costs is lowest. Returns the item of each robot."""
    bids, costs = {}, {}
    for item in items:
        name = item["name"]
        pose = next(one["properties"]["pose"] for one in item["services"] if one["type"] == "payload")
        call = fipa.Message("cfp", robots, json.dumps({"item": name, "pose": json.loads(pose)}))
        bids[name] = await agent.call_for_proposals(call, timeout=20)
        costs[name] = {bid.sender: float(bid.text) for bid in bids[name].proposals}
    ways = [dict(zip(robots, order)) for order in (bids, reversed(bids))]
    best = min(ways, key=lambda way: sum(costs[item].get(robot, float("inf")) for robot, item in way.items()))
    awards = []
    for robot, item in best.items():
        claim("award", item=item, bids=costs[item], robot=robot)
        awards.append(bids[item].award(*(bid for bid in bids[item].proposals if bid.sender == robot), timeout=20))
    # Both robots work at the same time.
    for results in await asyncio.gather(*awards):
        for failure in (it for it in results.values() if isinstance(it, Exception)):
            raise failure
    return best


async def work(agent: fipa.Agent, stack: list[str]) -> None:
    robots = [robot["name"] for robot in await find(agent, "fetch", 2)]
    items, (guide,) = await find(agent, "payload", 2), await find(agent, "guide", 1)
    fetched = await allocate(agent, robots, items)
    # The robot that gets the stack docks first: the other one holds its item until it comes.
    for robot in sorted(fetched, key=lambda robot: robot != "crex"):
        goal = {"item": fetched[robot], "client": "crex", "with": f"{stack[-1]}/b" if stack else "crex/top"}
        await agent.invoke(guide["name"], "dock", goal).result()
        stack.append(fetched[robot])
    await agent.request(fipa.Message(receivers="crex_stack", content="look"), timeout=20)


async def main() -> None:
    with fipa.Domain(settings=dict(pair.split("=", 1) for pair in PART["set"])) as domain:
        agent, stack, reason = await domain.register(PART["name"]), [], None
        claim("ready")
        try:
            await work(agent, stack)
        except fipa.Error as error:
            reason = str(error)
        claim("finished", stack=stack, reason=reason)
        await asyncio.to_thread(sys.stdin.read)


asyncio.run(main())
