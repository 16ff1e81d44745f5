"""A rover without an event loop: it asks the arm (arm.py) to lift a crate, and to move."""

import sys

import fipa

# ANCHOR: rover
with fipa.Domain() as domain:
    rover = domain.register("rover").wait()
    try:
        answer = rover.request(fipa.Message(receivers="arm_1", content="crate"), timeout=10).wait()
        print(answer.text)
        move = rover.invoke("arm_1", "move", {"x": 1.5, "steps": 3})
        for progress in move:
            print(f"{progress['fraction']:.0%} {progress['note']}")
        print(f"moved {move.result().wait()} m")
        with rover.subscribe("arm_1", "temperature") as temperatures:
            print(f"{next(temperatures).text} degrees")
    except fipa.Error as error:
        sys.exit(f"arm_1: {error}")
# ANCHOR_END: rover
