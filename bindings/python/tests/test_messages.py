"""Messages, loans, and the memory of contents."""

import array
import gc
import json
import signal
import time
import unittest
from datetime import datetime, timedelta, timezone

import fipa
from fipa import _log
from support import Case, finished, program, times

try:
    import numpy
except ImportError:
    numpy = None


class Messages(Case):
    def test_all_parameters_arrive(self) -> None:
        by = datetime.now(timezone.utc).replace(microsecond=0) + timedelta(hours=1)
        message = fipa.Message(
            "request",
            [self.arm.name],
            "(lift \u00fc \U0001f916)",
            reply_to=["operator"],
            language="fipa-sl",
            encoding="utf-8",
            ontology="crane",
            protocol="crane-lift",
            conversation_id="c1",
            reply_with="r1",
            in_reply_to="r0",
            reply_by=by,
            parameters={"x-priority": "high"},
        )
        self.rover.send(message).wait()
        letter = self.arm.receive().wait(timeout=30)
        self.assertEqual(letter.sender, self.rover.name)
        self.assertEqual(letter.receivers, (self.arm.name,))
        self.assertEqual(letter.text, message.content)
        self.assertEqual(letter.reply_by, by)
        self.assertEqual(letter.via, "shm")
        fields = letter.to_dict()
        self.assertEqual(fields.pop("sender"), self.rover.name)
        again = fipa.Message.from_dict(json.loads(json.dumps(fields)))
        self.assertEqual(again.to_dict(), message.to_dict())

    def test_an_answer_returns_to_the_sender(self) -> None:
        self.rover.send(fipa.Message("query-ref", self.arm.name, b"pose", reply_with="q")).wait()
        question = self.arm.receive().wait(timeout=30)
        self.arm.answer(question, fipa.Message("inform", content=b"\x00\xff")).wait()
        answer = self.rover.receive().wait(timeout=30)
        self.assertEqual((answer.in_reply_to, bytes(answer.content)), ("q", b"\x00\xff"))
        with self.assertRaises(UnicodeDecodeError):
            answer.text

    def test_contents_of_each_kind_arrive(self) -> None:
        numbers = array.array("d", [1.5, 2.5])
        # The limit of a letter is 64 MiB.
        large = bytes(range(256)) * 255 * 1024
        for content in ["", b"", bytearray(b"b"), memoryview(b"view"), numbers, large]:
            outcomes = self.rover.send(self.inform(content)).wait()
            self.assertEqual(outcomes.to_list()[0]["outcome"], "delivered")
            with self.arm.receive().wait(timeout=60) as letter:
                expected = content.encode() if isinstance(content, str) else bytes(content)
                self.assertTrue(letter.content == expected)
        with self.assertRaises(ValueError):
            letter.content

    def test_failures_name_the_reason(self) -> None:
        with self.assertRaisesRegex(fipa.NotDelivered, "nobody: failed: no such agent"):
            self.rover.send(fipa.Message("inform", "nobody", "x"), timeout=5).wait()
        with self.assertRaises(fipa.NameTaken):
            self.domain.register(self.arm.name).wait()
        with self.assertRaises(fipa.TimedOut):
            self.arm.receive().wait(timeout=0)
        with self.assertRaises(fipa.TooLarge):
            self.rover.loan(self.inform(None), 1 << 40)
        self.arm.deregister()
        with self.assertRaises(fipa.Closed):
            self.arm.receive().wait(timeout=30)
        with self.assertRaises(fipa.Closed):
            self.arm.send(self.inform("x")).wait()

    def test_wrong_input_is_an_error(self) -> None:
        wrong = [
            lambda: fipa.Domain("/no/such/file.toml"),
            lambda: fipa.Domain(settings={"no.such.key": 1}),
            lambda: self.rover.send(fipa.Message("", self.arm.name)),
            lambda: self.rover.send(fipa.Message("inform", self.arm.name, 5)),
            lambda: self.rover.send(fipa.Message("inform", self.arm.name, "\ud800")),
            lambda: self.rover.send("inform"),
            lambda: self.rover.send(fipa.Message("inform", ())).wait(),
            lambda: self.rover.send(fipa.Message("inform", "\0")).wait(),
            lambda: self.rover.send(self.inform("x"), timeout=-1),
            lambda: self.rover.send(self.inform("x"), timeout=float("nan")),
            lambda: self.rover.loan(self.inform("x"), -1),
            lambda: self.rover.receive().wait(timeout=-1),
            lambda: self.rover.send(fipa.Message("inform", self.arm.name, lock="lock")),
            lambda: self.rover.send(fipa.Message("inform", self.arm.name, reply_by="noon")),
            lambda: self.rover.subscribe(self.arm.name, "t", keep="some"),
            lambda: self.rover.lock(),
            lambda: self.rover.goals({"name": 5}),
            lambda: self.rover.invoke(self.arm.name, "move", [1]),
            lambda: fipa.sl.loads("(("),
            lambda: fipa.sl.dumps(object()),
        ]
        for index, call in enumerate(wrong):
            with self.subTest(index), self.assertRaises((fipa.Error, ValueError, TypeError, OverflowError, AttributeError)):
                call()

    def test_values_pass_through_sl(self) -> None:
        value = {"x": 1.5, "names": ["a", "b"], "on": True, "n": 3}
        self.assertEqual(fipa.sl.loads(fipa.sl.dumps(value)), value)

    def test_the_directory_reports_changes(self) -> None:
        changes = self.domain.changes()
        with self.domain.register("newcomer", type="lander").wait():
            self.assertEqual([it["name"] for it in self.domain.agents(type="lander")], ["newcomer"])
            while (change := changes.next().wait(timeout=30)):
                if change["agent"]["name"] == "newcomer":
                    break
            self.assertEqual(change["change"], "joined")
        changes.close()
        self.assertIsNone(changes.next().wait(timeout=30))


class Memory(Case):
    def test_a_view_outlives_the_letter_and_the_domain(self) -> None:
        self.rover.send(self.inform(b"ab" * 100_000)).wait()
        content = self.arm.receive().wait(timeout=30).content
        self.domain.close()
        gc.collect()
        self.assertTrue(content.readonly)
        self.assertEqual(bytes(content), b"ab" * 100_000)

    def test_a_loan_is_written_in_place_and_not_after_it_is_sent(self) -> None:
        loan = self.rover.loan(self.inform(None), 1_000_000)
        self.assertEqual(len(loan), 1_000_000)
        view = memoryview(loan)
        view[:3] = b"abc"
        with self.assertRaises(BufferError):
            loan.send()
        view.release()
        loan.send().wait()
        with self.assertRaises(BufferError):
            memoryview(loan)
        with self.assertRaises(BufferError):
            loan.send()
        letter = self.arm.receive().wait(timeout=30)
        self.assertEqual(bytes(letter.content[:3]), b"abc")
        with self.assertRaises(TypeError):
            letter.content[0] = 1

    def test_the_memory_of_a_content_stays_while_another_object_reads_it(self) -> None:
        self.rover.send(self.inform(b"x" * 10_000)).wait()
        letter = self.arm.receive().wait(timeout=30)
        other = memoryview(letter.content)
        letter.release()
        self.assertEqual(other[0], ord("x"))
        with self.assertRaises(ValueError):
            letter.content

    @unittest.skipIf(numpy is None, "numpy is not installed")
    def test_numpy_reads_and_writes_without_a_copy(self) -> None:
        loan = self.rover.loan(self.inform(None), 8 * 100_000)
        numpy.frombuffer(loan, dtype=numpy.float64)[:] = 2.5
        gc.collect()
        loan.send().wait()
        letter = self.arm.receive().wait(timeout=30)
        array = numpy.frombuffer(letter.content, dtype=numpy.float64)
        self.assertEqual(array.sum(), 2.5 * 100_000)
        address = numpy.frombuffer(letter.content, dtype=numpy.uint8).__array_interface__["data"][0]
        self.assertEqual(array.__array_interface__["data"][0], address)
        letter.release()
        self.assertEqual(array.sum(), 2.5 * 100_000)

    def test_a_letter_says_whether_its_content_is_in_place(self) -> None:
        for content, in_place in [(b"", False), (b"x" * 100, False), (b"x" * 10_000, True)]:
            self.rover.send(self.inform(content)).wait()
            with self.arm.receive().wait(timeout=30) as letter:
                self.assertEqual(letter.in_place, in_place, len(content))
        self.assertEqual(self.domain.content_counts(), {"in_place": 1, "copied": 0})

    def test_hundreds_of_views_do_not_stop_the_other_receivers(self) -> None:
        views = []
        for number in range(300):
            self.rover.send(self.inform(number.to_bytes(4, "big") * 2_500)).wait()
            views.append(self.arm.receive().wait(timeout=30).content)
        for number, view in enumerate(views):
            self.assertEqual(view[:4], number.to_bytes(4, "big"))

    def test_a_program_that_keeps_images_gets_copies_and_slows_no_other_one(self) -> None:
        count = times(200, 1_000)
        camera, viewer = f"camera_{count}", f"viewer_{count}"
        filming = program(f"""
            with fipa.Domain() as domain:
                agent = domain.register("{camera}").wait()
                with agent.publisher("image") as images:
                    print("ready", flush=True)
                    while images.subscribers < 2:
                        time.sleep(0.01)
                    due = time.monotonic()
                    for number in range({count}):
                        loan = images.loan(1_000_000)
                        with memoryview(loan) as view:
                            view[:4] = view[-4:] = number.to_bytes(4, "big")
                        loan.publish().wait()
                        due += 1 / 30
                        time.sleep(max(0, due - time.monotonic()))
                    sys.stdin.read()
        """)
        self.addCleanup(filming.communicate)
        self.assertEqual(filming.stdout.readline(), "ready\n")
        viewing = program(f"""
            with fipa.Domain() as domain:
                agent = domain.register("{viewer}").wait()
                images = agent.subscribe("{camera}", "image", keep="all")
                in_place = 0
                for number in range({count}):
                    with next(images) as image:
                        assert image.missed == 0 and image.content[:4] == number.to_bytes(4, "big")
                        in_place += image.in_place
                assert in_place > {count} / 2, in_place
        """)
        kept = []
        with self.assertLogs("fipa", "WARNING") as logs:
            with self.rover.subscribe(camera, "image", keep="all") as images:
                while len(kept) < count:
                    kept.append(next(images))
            # The lines of the library are delivered by the calls of the program.
            self.domain.agents()
        finished(self, viewing)
        for number, image in enumerate(kept):
            self.assertEqual((image.missed, image.content[-4:]), (0, number.to_bytes(4, "big")))
        in_place = sum(image.in_place for image in kept)
        counts = self.domain.content_counts()
        # A content that the sender has repeated has arrived once, and is counted each time.
        self.assertGreaterEqual(counts["copied"], count - in_place)
        self.assertGreater(in_place, 14)
        self.assertLess(in_place, count)
        lines = [line for line in logs.output if "keeps the content of letters" in line]
        self.assertEqual(len(lines), 1, logs.output)

    def test_letters_do_not_leak(self) -> None:
        def pages() -> int:
            with open("/proc/self/statm") as statm:
                return int(statm.read().split()[1])

        def exchange(count: int) -> None:
            for _ in range(count):
                self.rover.send(self.inform(b"x" * 1_000)).wait()
                self.arm.receive().wait(timeout=30)

        exchange(2_000)
        before = pages()
        exchange(times(10_000, 1_000_000))
        # 10,000 letters of 1 KB that stayed would be 2,500 pages.
        self.assertLess(pages() - before, 1_000)


class Logging(unittest.TestCase):
    def test_lines_of_the_library_go_to_logging(self) -> None:
        with self.assertLogs("fipa", "INFO") as logs:
            with fipa.Domain() as domain, domain.register("logged").wait():
                pass
        joined = [line for line in logs.output if line.startswith("INFO:fipa.domain.change_log:joined name=logged ")]
        self.assertEqual(len(joined), 1, logs.output)

    def test_the_level_of_the_logger_is_that_of_the_library(self) -> None:
        with self.assertNoLogs("fipa", "WARNING"):
            with fipa.Domain() as domain, domain.register("not_logged").wait():
                pass

    def test_dropped_lines_are_counted(self) -> None:
        with self.assertLogs("fipa") as logs:
            _log.emit([(30, "fipa.mts.core", "{is not a format} %s")], 2)
        self.assertEqual(
            logs.output,
            [
                "WARNING:fipa.mts.core:{is not a format} %s",
                "WARNING:fipa:2 older lines were dropped: there were too many at once",
            ],
        )

    def test_a_program_that_only_waits_logs_at_once(self) -> None:
        waits = ["time.sleep(60)", "asyncio.run(asyncio.sleep(60))", "asyncio.run(receive())"]
        for number, wait in enumerate(waits):
            with self.subTest(wait):
                other = program(
                    f"""
                    import logging
                    logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
                    domain = fipa.Domain()
                    agent = domain.register("waits_{number}").wait()
                    async def receive():
                        await asyncio.wait_for(agent.receive(), 60)
                    # One write: the thread that logs writes, too.
                    logging.info("ready")
                    {wait}
                    """
                )
                lines = iter(other.stdout.readline, "")
                self.assertTrue(any(line == "ready\n" for line in lines))
                began = time.monotonic()
                with fipa.Domain() as domain, domain.register(f"late_{number}").wait():
                    self.assertTrue(any(line.startswith(f"joined name=late_{number} ") for line in lines))
                self.assertLess(time.monotonic() - began, 30)
                other.send_signal(signal.SIGINT)
                other.communicate(timeout=60)

    def test_a_handler_that_calls_the_library_gets_each_line_once(self) -> None:
        other = program(
            """
            import logging
            domain = fipa.Domain()
            agent = domain.register("logger").wait()

            class Sender(logging.Handler):
                def emit(self, record):
                    if "name=logged_" in record.getMessage():
                        agent.send(fipa.Message("inform", "logger", record.getMessage()))

            logging.getLogger().addHandler(Sender())
            logging.getLogger().setLevel(logging.INFO)
            second = fipa.Domain()
            agents = [second.register(f"logged_{number}").wait() for number in range(5)]
            for number in range(5):
                assert agent.receive().wait(timeout=60).text.startswith(f"joined name=logged_{number} ")
            print("all")
            """
        )
        self.assertEqual(finished(self, other), "all\n")


class Crash(Case):
    def test_a_killed_process_leaves_its_name_free(self) -> None:
        other = program(
            """
            domain = fipa.Domain()
            agent = domain.register("victim").wait()
            print("ready", flush=True)
            views = []
            while True:
                views.append(agent.receive().wait().content)
            """
        )
        self.assertEqual(other.stdout.readline(), "ready\n")
        self.rover.send(fipa.Message("inform", "victim", b"x" * 100_000)).wait()
        other.kill()
        other.communicate()
        deadline = self.domain.changes()
        while self.domain.agents("victim"):
            deadline.next().wait(timeout=60)
        self.domain.register("victim").wait()

    def test_a_process_of_its_own_is_another_agent(self) -> None:
        other = program(
            f"""
            with fipa.Domain() as domain:
                agent = domain.register("other").wait()
                agent.send(fipa.Message("inform", "{self.arm.name}", "here")).wait()
            """
        )
        self.assertEqual(self.arm.receive().wait(timeout=60).sender, "other")
        finished(self, other)


if __name__ == "__main__":
    unittest.main()
