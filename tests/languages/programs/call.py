"""An operator in Python, which has crates carried. Usage: call.py NAME

The position of a crate is a line of the standard input. The operator prints the proposals of the carriers, and awards
the nearest one after a further line.
"""

import json
import sys

import fipa


def distance(proposal: fipa.Letter) -> float:
    return float(json.loads(proposal.text)["distance"])


with fipa.Domain() as domain:
    operator = domain.register(sys.argv[1]).wait()
    print("ready", flush=True)
    for position in sys.stdin:
        x, y = map(float, position.split())
        call = fipa.Message(receivers="carrier_.*", language="json", content=json.dumps({"x": x, "y": y}))
        bids = operator.call_for_proposals(call, timeout=60).wait()
        proposals = sorted(bids.proposals, key=distance)
        for proposal in proposals:
            print(f"{proposal.sender} at {distance(proposal):.1f}")
        print(f"{len(bids.answers['refusals'])} refused", flush=True)
        sys.stdin.readline()
        for name, result in bids.award(*proposals[:1]).wait().items():
            answer = result.text if isinstance(result, fipa.Letter) else type(result).__name__
            print(f"{name}: {answer}", flush=True)
