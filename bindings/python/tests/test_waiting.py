"""Waits: event loops, threads, signals, forks, and the end of the interpreter."""

import asyncio
import os
import random
import signal
import threading
import time
import unittest

import fipa
from support import Case, Loops, finished, program, times


class Cancelling(Loops):
    async def test_a_cancelled_wait_loses_no_letter(self) -> None:
        letters = times(10_000, 100_000)
        choice = random.Random(7)

        async def send() -> None:
            for first in range(0, letters, 50):
                numbers = range(first, first + 50)
                for sent in [self.rover.send(self.inform(number.to_bytes(4, "big"))) for number in numbers]:
                    await sent

        sending = asyncio.ensure_future(send())
        received, cancelled = [], 0
        while len(received) < letters:
            try:
                limit = choice.choice([0, 0, 0.00001, 0.0001, 1])
                letter = await asyncio.wait_for(self.arm.receive(), limit)
            except asyncio.TimeoutError:
                cancelled += 1
                await asyncio.sleep(0)
            else:
                received.append(int.from_bytes(letter.content, "big"))
        await sending
        self.assertEqual(received, list(range(letters)))
        self.assertGreater(cancelled, 100)

    async def test_a_task_that_is_cancelled_after_the_arrival_leaves_the_letter(self) -> None:
        async def receive() -> fipa.Letter:
            return await self.arm.receive()

        task = asyncio.ensure_future(receive())
        await asyncio.sleep(0)
        self.rover.send(self.inform("kept")).wait()
        task.cancel()
        with self.assertRaises(asyncio.CancelledError):
            await task
        self.assertEqual((await self.arm.receive()).text, "kept")

    async def test_a_value_is_awaited_once(self) -> None:
        pending = self.rover.send(self.inform("x"))
        await pending
        with self.assertRaises(RuntimeError):
            await pending
        with self.assertRaises(RuntimeError):
            pending.wait()

    async def test_a_loop_with_letters_does_its_other_work(self) -> None:
        turns = 0

        async def count() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        for number in range(200):
            self.rover.send(self.inform(str(number))).wait()
        counting = asyncio.ensure_future(count())
        for _ in range(200):
            await self.arm.receive()
        counting.cancel()
        self.assertGreaterEqual(turns, 3)

    async def test_a_request_that_no_one_awaits_is_a_warning(self) -> None:
        with self.assertWarnsRegex(RuntimeWarning, r"Agent.request\(\) has no effect"):
            self.rover.request(fipa.Message(receivers=self.arm.name))

    def test_loops_of_several_threads_share_a_domain(self) -> None:
        async def ping(number: int) -> str:
            with self.domain.register(f"thread_{number}").wait() as agent:
                agent.send(fipa.Message("inform", agent.name, str(number)))
                return (await agent.receive()).text

        texts = [""] * 8

        def run(number: int) -> None:
            texts[number] = asyncio.run(ping(number))

        threads = [threading.Thread(target=run, args=(number,)) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self.assertEqual(texts, [str(number) for number in range(8)])


class Threads(Case):
    def test_a_hundred_threads_receive_each_letter_once(self) -> None:
        received, lock = [], threading.Lock()

        def receive() -> None:
            while (text := self.arm.receive().wait(timeout=60).text) != "end":
                with lock:
                    received.append(int(text))

        threads = [threading.Thread(target=receive) for _ in range(100)]
        for thread in threads:
            thread.start()
        for number in range(2_000):
            self.rover.send(self.inform(str(number))).wait()
        for _ in threads:
            self.rover.send(self.inform("end")).wait()
        for thread in threads:
            thread.join()
        self.assertEqual(sorted(received), list(range(2_000)))

    def test_a_wait_leaves_the_interpreter_to_other_threads(self) -> None:
        waiting = threading.Thread(target=lambda: self.arm.receive().wait())
        waiting.start()
        # Would not end if the wait kept the interpreter.
        total = sum(range(1_000_000))
        self.assertTrue(waiting.is_alive())
        self.assertEqual(total, 499_999_500_000)
        self.rover.send(self.inform("end")).wait()
        waiting.join()

    def test_a_signal_ends_a_wait(self) -> None:
        other = program(
            """
            domain = fipa.Domain()
            agent = domain.register("interrupted").wait()
            try:
                print("ready", flush=True)
                agent.receive().wait()
            except KeyboardInterrupt:
                print("interrupted")
            """
        )
        self.assertEqual(other.stdout.readline(), "ready\n")
        other.send_signal(signal.SIGINT)
        self.assertEqual(finished(self, other), "interrupted\n")

    def test_the_default_of_ctrl_c_ends_a_program_with_a_loop(self) -> None:
        other = program(
            """
            async def main():
                agent = await fipa.Domain().register("interrupted_loop")
                print("ready", flush=True)
                await agent.receive()
            asyncio.run(main())
            """
        )
        self.assertEqual(other.stdout.readline(), "ready\n")
        other.send_signal(signal.SIGINT)
        _, errors = other.communicate(timeout=60)
        self.assertIn("KeyboardInterrupt", errors)


class Processes(Case):
    def test_a_forked_child_gets_an_error(self) -> None:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                self.rover.send(self.inform("x"))
            except fipa.Forked as error:
                os.write(writing, str(error).encode())
            finally:
                os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as errors:
            self.assertIn("was forked", errors.read())
        os.waitpid(child, 0)
        self.rover.send(self.inform("parent")).wait()
        self.assertEqual(self.arm.receive().wait(timeout=30).text, "parent")

    def test_spawned_processes_work(self) -> None:
        other = program(
            """
            import multiprocessing
            domain = fipa.Domain()
            child = multiprocessing.get_context("spawn").Process(target=fipa.Domain)
            child.start()
            child.join()
            print(child.exitcode)
            """
        )
        self.assertEqual(finished(self, other), "0\n")

    def test_the_interpreter_ends_at_any_moment(self) -> None:
        moments = {
            "receiving": "threading.Thread(target=lambda: agent.receive().wait(), daemon=True).start()",
            "iterating": "threading.Thread(target=lambda: next(iter(domain.changes())), daemon=True).start()",
            "serving": "agent.serve('fipa-request', lambda task: time.sleep(60))",
            "handling": "begun = threading.Event(); client = domain.register(f'{agent.name}_client').wait(); "
            "agent.serve('fipa-request', lambda task: begun.set() or agent.receive().wait()); "
            "request = client.request(fipa.Message(receivers=agent.name, content='x')); "
            "threading.Thread(target=request.wait, daemon=True).start(); begun.wait()",
            "loan": "loan = agent.loan(fipa.Message('inform', agent.name), 1_000_000); view = memoryview(loan)",
            "letter": "agent.send(fipa.Message('inform', agent.name, b'x' * 100_000)).wait(); c = agent.receive().wait().content",
            "loop": "loop = asyncio.new_event_loop(); loop.call_later(0.01, loop.stop); "
            "task = loop.create_task(receive(agent)); loop.run_forever()",
            "publishing": "publisher = agent.publisher('t'); agent.subscribe(agent.name, 't')",
            "request": "agent.begin_request(fipa.Message(receivers=agent.name, content='x')).result()",
        }
        choice = random.Random(5)
        for name, source in moments.items():
            running = []
            for number in range(times(3, 120)):
                running.append(
                    program(
                        f"""
async def receive(agent):
    return await agent.receive()
domain = fipa.Domain()
agent = domain.register("{name}_{number}").wait()
{source}
time.sleep({choice.random() * 0.05})
                        """
                    )
                )
                if len(running) == 3:
                    self._finish(name, running)
            self._finish(name, running)

    def _finish(self, name: str, running: list) -> None:
        while running:
            with self.subTest(name):
                finished(self, running.pop())


if __name__ == "__main__":
    unittest.main()
