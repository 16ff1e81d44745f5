"""The server in Python. Usage: serve.py NAME"""

import asyncio
import sys
import zlib

import fipa


def sum_of(content: memoryview) -> str:
    """Returns the length and the Adler-32 checksum of a content."""
    return f"{len(content)} bytes, {zlib.adler32(content):08x}, 谢谢 🤖"


async def answer(agent: fipa.Agent) -> None:
    """Answers letters."""
    while True:
        letter = await agent.receive()
        if letter.violation:
            report = fipa.Message("inform", letter.sender, letter.violation, conversation_id="violation report")
            await agent.send(report)
        elif letter.performative == "inform":
            with letter.content as content:
                summed = sum_of(content)
            await agent.answer(letter, fipa.Message("inform", content=summed))


def serve(agent: fipa.Agent, second: fipa.Agent, bay: fipa.Owned, charge: fipa.Publisher) -> list[fipa.Server]:
    go_on = asyncio.Event()
    # The last command with a fence.
    command: fipa.Letter

    def checked(letter: fipa.Letter) -> str:
        try:
            bay.check(letter)
        except fipa.Error as error:
            return type(error).__name__
        return "admitted"

    @agent.action
    async def count(goal: fipa.Goal, to: int) -> int:
        """Counts to the number of the goal when the leader lets it go on."""
        goal.progress(0.5, "half way")
        await go_on.wait()
        go_on.clear()
        return to

    @agent.serve("fipa-request")
    async def handle(task: fipa.Task) -> str | None:
        nonlocal command
        match task.letter.text.split(" ", 1):
            case ["lift"]:
                await task.agree()
                return "lifted"
            case ["drop"]:
                raise fipa.Refuse("too heavy")
            case ["throw"]:
                await task.agree()
                await task.fail("no motor")
            case ["wait"]:
                await task.agree()
                # Until the leader cancels, which the package confirms.
                await asyncio.Event().wait()
            case ["go"]:
                go_on.set()
            case ["publish", percent]:
                await charge.publish(percent)
            case ["dock"]:
                command = task.letter
                return checked(command)
            case ["lock", millis]:
                try:
                    async with second.lock("bay", timeout=int(millis) / 1000) as lock:
                        await task.inform(f"{checked(command)} {lock.fence}")
                except fipa.Error as error:
                    return type(error).__name__
            case _:
                raise fipa.Refuse("unknown")
        return None

    return [count, handle]


async def main(name: str) -> None:
    with fipa.Domain() as domain:
        agent = await domain.register(name)
        second = await domain.register(f"{name}_2")
        bay = await agent.own("bay", volatile=True, forget=True)
        charge = agent.publisher("charge", latched=1)
        await charge.publish("90")
        servers = serve(agent, second, bay, charge)
        print("ready", flush=True)
        await asyncio.gather(answer(agent), answer(second))
        del servers


asyncio.run(main(sys.argv[1]))
