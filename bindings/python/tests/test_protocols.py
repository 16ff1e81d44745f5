"""Conversations, topics, locks, actions and coalitions."""

import asyncio
import logging
import time
import unittest

import fipa
from fipa._serve import _Workers as Workers
from support import Case, Loops


class Conversations(Loops):
    def request(self, content: str) -> fipa.Message:
        return fipa.Message(receivers=self.arm.name, content=content)

    async def test_a_coroutine_serves_requests(self) -> None:
        @self.arm.serve("fipa-request")
        async def lift(task: fipa.Task) -> str | None:
            await task.agree()
            match task.letter.text:
                case "refuse":
                    raise fipa.Refuse("too heavy")
                case "fail":
                    raise ValueError("no hook")
                case "nothing":
                    return None
            return f"lifted {task.letter.text}"

        self.assertEqual((await self.rover.request(self.request("crate"), timeout=30)).text, "lifted crate")
        self.assertEqual((await self.rover.request(self.request("nothing"), timeout=30)).text, "")
        with self.assertLogs("fipa", logging.ERROR), self.assertRaisesRegex(fipa.Refused, "ValueError: no hook"):
            await self.rover.request(self.request("fail"), timeout=30)
        request = self.rover.begin_request(self.request("crate"), timeout=30)
        self.assertTrue(await request.agreed())
        self.assertEqual((await request.result()).text, "lifted crate")
        lift.close()

    async def test_a_request_begins_before_the_program_waits(self) -> None:
        request = self.rover.begin_request(self.request("crate"), timeout=30)
        letter = await self.arm.receive()
        self.assertEqual(letter.text, "crate")
        await self.arm.answer(letter, fipa.Message("agree"))
        self.assertTrue(await request.agreed())

    async def test_a_goal_begins_before_the_program_waits(self) -> None:
        goal = self.rover.invoke(self.arm.name, "dig")
        self.assertEqual((await self.arm.receive()).performative, "request")
        del goal

    async def test_a_refusal_has_its_reason(self) -> None:
        @self.arm.serve("fipa-request")
        def lift(task: fipa.Task) -> None:
            raise fipa.Refuse("too heavy")

        with self.assertRaisesRegex(fipa.Refused, "^the other side refused: too heavy$"):
            await self.rover.request(self.request("crate"), timeout=30)

    async def test_a_cancel_reaches_the_handler(self) -> None:
        cancelled = asyncio.Event()

        @self.arm.serve("fipa-request")
        async def lift(task: fipa.Task) -> None:
            await task.agree()
            try:
                await asyncio.sleep(3600)
            finally:
                cancelled.set()

        request = self.rover.begin_request(self.request("crate"))
        self.assertTrue(await request.agreed())
        request.cancel()
        with self.assertRaises(fipa.Cancelled):
            await request.result()
        await cancelled.wait()

    def test_a_plain_function_serves_without_a_loop(self) -> None:
        with self.arm.serve("fipa-query", lambda task: b"pose"):
            question = fipa.Message("query-ref", self.arm.name, "pose")
            self.assertEqual(bytes(self.rover.request(question, timeout=30).wait().content), b"pose")

    def test_requests_that_wait_for_a_server_are_answered(self) -> None:
        for number in range(10):
            # A server that ends may still take a conversation, so each one has an agent of its own.
            arm = self.domain.register(f"{self.arm.name}_{number}").wait()
            message = fipa.Message("request", arm.name, "crate")
            request = self.rover.begin_request(message, timeout=30)
            with arm.serve("fipa-request", lambda task: "lifted"):
                self.assertEqual(request.result().wait().text, "lifted")

    def test_a_handler_is_called_for_a_conversation_that_was_taken_before_the_end(self) -> None:
        workers = Workers()
        self.assertEqual(workers.submit(lambda: "before").result(timeout=30), "before")
        workers.close()
        self.assertEqual(workers.submit(lambda: "after").result(timeout=30), "after")

    def test_a_task_that_is_dropped_fails(self) -> None:
        tasks = self.arm.tasks("fipa-request")
        request = self.rover.begin_request(self.request("crate"), timeout=30)
        result = []
        import threading

        def wait() -> None:
            try:
                request.result().wait()
            except fipa.Refused as error:
                result.append(str(error))

        waiting = threading.Thread(target=wait)
        waiting.start()
        task = next(tasks)
        self.assertEqual(task.letter.text, "crate")
        del task
        waiting.join()
        self.assertIn("without a last message", result[0])

    async def test_proposals_are_awarded(self) -> None:
        other = await self.domain.register(f"{self.arm.name}_2")
        done = []
        for agent, price in [(self.arm, "5"), (other, "3")]:

            @agent.serve("fipa-contract-net")
            async def bid(task: fipa.Task, name: str = agent.name, price: str = price) -> str | None:
                if not await task.propose(price):
                    return None
                done.append(name)
                return f"done by {name}"

        busy = await self.domain.register(f"{other.name}_busy")

        @busy.serve("fipa-contract-net")
        async def refuse(task: fipa.Task) -> None:
            raise fipa.Refuse("busy")

        call = fipa.Message(receivers=[self.arm.name, other.name, busy.name], content="(lift crate)")
        bids = await self.rover.call_for_proposals(call, timeout=30)
        self.assertEqual(len(bids.proposals), 2)
        self.assertEqual(bids.answers["silent"], [])
        (refusal,) = bids.answers["refusals"]
        self.assertEqual(refusal["agent"], busy.name)
        self.assertIn("busy", refusal["reason"])
        best = min(bids.proposals, key=lambda letter: int(letter.text))
        results = await bids.award(best)
        self.assertEqual({name: result.text for name, result in results.items()}, {other.name: f"done by {other.name}"})
        self.assertEqual(done, [other.name])
        with self.assertRaises(fipa.Closed):
            bids.award()


class Topics(Loops):
    async def test_notifications_arrive_in_order(self) -> None:
        with self.arm.publisher("pose", latched=1) as publisher:
            await publisher.publish("0")
            poses = self.rover.subscribe(self.arm.name, "pose", keep="all")
            received = [int((await poses.next()).text)]
            for number in range(1, 100):
                await publisher.publish(str(number))
            async for pose in poses:
                received.append(int(pose.text))
                if received[-1] == 99:
                    break
            self.assertEqual(received, list(range(100)))
            poses.close()
            self.assertIsNone(await poses.next())

    async def test_notifications_name_their_language_and_ontology(self) -> None:
        with self.arm.publisher("pose", language="json", ontology="geometry_msgs/Pose", latched=1) as publisher:
            await publisher.publish("{}")
            pose = await self.rover.subscribe(self.arm.name, "pose").next()
            self.assertEqual((pose.language, pose.ontology), ("json", "geometry_msgs/Pose"))

    async def test_a_loan_is_published_in_place(self) -> None:
        with self.arm.publisher("image", latched=1) as publisher:
            loan = publisher.loan(1_000_000)
            with memoryview(loan) as view:
                view[:5] = b"image"
                with self.assertRaises(BufferError):
                    loan.publish()
            await loan.publish()
            with self.rover.subscribe(self.arm.name, "image") as images, await images.next() as image:
                self.assertEqual((len(image.content), bytes(image.content[:5])), (1_000_000, b"image"))

    def test_a_subscription_to_no_topic_is_an_error(self) -> None:
        with self.assertRaises(fipa.Error):
            self.rover.subscribe(self.arm.name, "none", timeout=5).next().wait()


class Locks(Loops):
    async def test_a_lock_guards_commands(self) -> None:
        resource = f"{self.arm.name}/gripper"
        with await self.arm.own(resource, volatile=True, forget=True) as gripper:
            async with self.rover.lock(resource, timeout=30) as lock:
                self.assertTrue(lock.is_held)
                command = fipa.Message("inform", self.arm.name, "close", lock=lock)
                await self.rover.send(command)
                letter = await self.arm.receive()
                gripper.check(letter)
                lost = asyncio.ensure_future(self.reason(lock))
            self.assertIsInstance(await lost, fipa.Error)
            with self.assertRaises(fipa.Lost):
                self.rover.send(command)
            with self.rover.lock(resource, timeout=30).wait():
                # The command of the first lock comes late.
                with self.assertRaises(fipa.Stale):
                    gripper.check(letter)

    @staticmethod
    async def reason(lock: fipa.Lock) -> Exception:
        return await lock.lost()

    async def test_a_lock_without_an_owner_times_out(self) -> None:
        with self.assertRaises(fipa.TimedOut):
            await self.rover.lock("unowned", timeout=0.2)


class Actions(Loops):
    async def test_a_function_is_an_action(self) -> None:
        seen = asyncio.Event()

        @self.arm.action
        async def move(goal: fipa.Goal, x: float, steps: int = 2) -> float:
            """Moves along x."""
            for step in range(steps):
                goal.progress(step / steps, f"step {step}", {"x": x * step})
                await asyncio.sleep(0.15)
            await asyncio.wait_for(seen.wait(), 30)
            return x * steps

        (description,) = await self.rover.actions(self.arm.name)
        self.assertEqual((description["name"], description["description"]), ("move", "Moves along x."))
        self.assertEqual([it["type"] for it in description["parameters"]], ["number", "integer"])
        goal = self.rover.invoke(self.arm.name, "move", {"x": 1.5, "steps": 3})
        async for progress in goal:
            if progress["note"] == "step 2":
                seen.set()
        self.assertTrue(seen.is_set())
        self.assertEqual(await goal.result(), 4.5)
        with self.assertRaises(fipa.Refused):
            await self.rover.invoke(self.arm.name, "move", {"x": "far"}).result()
        move.close()

    async def test_a_goal_is_cancelled(self) -> None:
        @self.arm.action(name="dig")
        def dig(goal: fipa.Goal) -> None:
            while goal.stop_reason is None:
                time.sleep(0.01)

        goal = self.rover.invoke(self.arm.name, "dig")
        async for progress in goal:
            break
        goal.cancel()
        with self.assertRaises(fipa.Cancelled):
            await goal.result()

    async def test_the_program_decides_about_a_goal(self) -> None:
        with self.arm.goals({"name": "reach", "decides": True, "concurrency": 2}) as goals:
            sent = self.rover.invoke(self.arm.name, "reach", {})
            goal = await goals.next()
            self.assertEqual(goal.client, self.rover.name)
            self.assertTrue(goal.id)
            accepted = asyncio.ensure_future(sent.accepted())
            await asyncio.sleep(0.05)
            self.assertFalse(accepted.done())
            other = self.rover.invoke(self.arm.name, "reach", {})
            rejected = await goals.next()
            self.assertNotEqual(goal.id, rejected.id)
            rejected.fail("out of reach")
            for wait in (other.accepted, other.accepted, other.result):
                with self.assertRaisesRegex(fipa.Refused, "the robot rejects the goal: out of reach"):
                    await wait()
            goal.accept()
            self.assertIsNone(await accepted)
            goal.progress(0.5, "near")
            async for progress in sent:
                if progress["note"] == "near":
                    break
            self.assertIsNone(await sent.accepted())
            goal.succeed(3)
            self.assertEqual(await sent.result(), 3)
            self.assertIsNone(await sent.accepted())

    async def test_a_goal_that_ends_before_its_action_has_its_own_outcome(self) -> None:
        for number in range(20):
            goals = self.arm.goals({"name": "reach"})
            sent = self.rover.invoke(self.arm.name, "reach", {})
            goal = await goals.next()
            goal.fail(f"reason {number}")
            goals.close()
            with self.assertRaisesRegex(fipa.Refused, f"reason {number}"):
                await sent.result()

    async def test_a_goal_is_accepted_while_another_wait_has_its_events(self) -> None:
        with self.arm.goals({"name": "reach", "decides": True}) as goals:
            sent = self.rover.invoke(self.arm.name, "reach", {})
            result = asyncio.ensure_future(sent.result())
            await asyncio.sleep(0.05)
            goal = await goals.next()
            goal.accept()
            await sent.accepted()
            goal.succeed()
            self.assertIsNone(await result)

    async def test_a_goal_is_cancelled_before_it_is_accepted(self) -> None:
        with self.arm.goals({"name": "reach", "decides": True}) as goals:
            sent = self.rover.invoke(self.arm.name, "reach", {})
            goal = await goals.next()
            sent.cancel()
            accepted = asyncio.ensure_future(sent.accepted())
            await goal.stopped()
            goal.fail("stopped")
            with self.assertRaises(fipa.Cancelled):
                await accepted

    async def test_a_goal_that_is_sent_again_with_its_id_runs_once(self) -> None:
        with self.arm.goals({"name": "reach", "result": "integer"}) as goals:
            first = self.rover.invoke(self.arm.name, "reach", {}, id="reach-17")
            goal = await goals.next()
            self.assertEqual((first.id, goal.id), ("reach-17", "reach-17"))
            again = self.rover.invoke(self.arm.name, "reach", {}, id=first.id)
            await again.accepted()
            goal.succeed(3)
            self.assertEqual([await first.result(), await again.result()], [3, 3])
            # After its end, too.
            self.assertEqual(await self.rover.invoke(self.arm.name, "reach", {}, id="reach-17").result(), 3)
            other = self.rover.invoke(self.arm.name, "reach", {})
            goal = await goals.next()
            self.assertEqual(goal.id, other.id)
            goal.succeed(4)
            self.assertEqual(await other.result(), 4)

    async def test_the_end_of_a_block_cancels_a_goal(self) -> None:
        with self.arm.goals({"name": "reach", "client_gone": "continue"}) as goals:
            with self.assertRaisesRegex(ValueError, "mine"):
                async with self.rover.invoke(self.arm.name, "reach", {}) as sent:
                    goal = await goals.next()
                    await sent.accepted()
                    raise ValueError("mine")
            await goal.stopped()
            self.assertEqual(goal.stop_reason, "the goal was cancelled")
            goal.fail(goal.stop_reason)
            with self.assertRaises(fipa.Cancelled):
                await sent.result()

            # Without a wait for the outcome.
            with self.rover.invoke(self.arm.name, "reach", {}):
                goal = await goals.next()
            await goal.stopped()
            goal.fail("stopped")

            with self.rover.invoke(self.arm.name, "reach", {}) as sent:
                (await goals.next()).succeed(3)
                self.assertEqual(await sent.result(), 3)
            self.assertEqual(await sent.result(), 3)

    async def test_a_goal_that_is_dropped_goes_on(self) -> None:
        with self.arm.goals({"name": "reach", "client_gone": "continue"}) as goals:
            sent = self.rover.invoke(self.arm.name, "reach", {}, id="dropped")
            goal = await goals.next()
            await sent.accepted()
            del sent
            await asyncio.sleep(0.3)
            self.assertIsNone(goal.stop_reason)
            goal.succeed(3)
            self.assertEqual(await self.rover.invoke(self.arm.name, "reach", {}, id="dropped").result(), 3)

    async def test_the_progress_of_a_cancelled_goal_arrives(self) -> None:
        with self.arm.goals({"name": "reach"}) as goals:
            sent = self.rover.invoke(self.arm.name, "reach", {})
            goal = await goals.next()
            await sent.accepted()
            sent.cancel()
            await goal.stopped()
            goal.progress(0.5, "stops")
            await asyncio.sleep(0.3)
            goal.fail("stopped")
            notes = []
            with self.assertRaises(fipa.Cancelled):
                async for progress in sent:
                    notes.append(progress["note"])
            self.assertIn("stops", notes)

    async def test_goals_need_the_fence_of_a_lock_and_a_wrong_option_is_named(self) -> None:
        fenced = {"name": "lift", "fenced_by": {"owner": self.arm.name, "resource": "bay"}, "client_gone": "continue"}
        with self.arm.goals(fenced):
            with self.assertRaisesRegex(fipa.Refused, "needs the fence of a lock"):
                await self.rover.invoke(self.arm.name, "lift", {}).accepted()
        with self.assertRaisesRegex(ValueError, '"client_gone" is "ignore"; expected "cancel" or "continue"'):
            self.arm.goals({"name": "lift", "client_gone": "ignore"})

    async def test_the_time_of_a_goal_is_limited(self) -> None:
        @self.arm.action
        async def wait(goal: fipa.Goal) -> None:
            await asyncio.sleep(3600)

        with self.assertRaises(fipa.Error):
            await self.rover.invoke(self.arm.name, "wait", timeout=0.3).result()


class Coalitions(Loops):
    async def test_a_member_leads(self) -> None:
        name = f"team_{self.arm.name}"
        options = {"volatile": True, "forget": True}
        with await self.rover.found_coalition(name, [self.arm.name], **options):
            with self.arm.join_coalition(name) as member:
                async for state in member.changes():
                    if state["leads"] and state["leader"]:
                        break
                self.assertEqual(state["leader"], self.arm.name)
                await self.rover.send(fipa.Message("inform", name, "to the leader"))
                self.assertEqual((await self.arm.receive()).text, "to the leader")
                await self.arm.send(fipa.Message("inform", self.rover.name, "go", lock=member))
                order = await self.rover.receive()
                with self.rover.join_coalition(name) as other:
                    other.check(order)


if __name__ == "__main__":
    unittest.main()
