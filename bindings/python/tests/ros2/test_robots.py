"""Robots of ROS as agents: unmodified nodes of rclpy, commanded by agents."""

import json
import subprocess
import sys
import unittest

from rclpy.serialization import deserialize_message
from std_msgs.msg import Int64
from support import LONG, Site, until

import fipa

MAPPING = """
actions = ["/crex/count_up"]
services = ["/crex/double"]
topics = ["/crex/count", "/crex/map", "/crex/raw/*"]
"""


class Robots(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        cls.site = Site()
        cls.addClassCleanup(cls.site.close)
        cls.gateway = cls.site.start("fipa", "up", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        cls.robot = cls.site.robot("crex")
        cls.bridge = cls.site.bridge(MAPPING)
        cls.domain = fipa.Domain()
        cls.addClassCleanup(cls.domain.close)
        cls.own = cls.domain.register("operator").wait()
        for name in ("count_up", "double", "count", "map"):
            until(lambda name=name: cls.bridge.has_logged(f"/crex/{name} is "), f"the mapping of {name}")

    def do(self, *arguments: str) -> "subprocess.CompletedProcess[str]":
        return self.site.fipa("do", "crex", "count_up", *arguments)

    def test_a_goal_runs_with_progress_to_its_result(self) -> None:
        done = self.do("order=6", "--json")
        self.assertEqual(done.returncode, 0, done.stderr)
        last = json.loads(done.stdout.splitlines()[-1])
        self.assertEqual(last, {"event": "done", "result": "(object :sequence (sequence 0 1 1 2 3 5))"})

    def test_progress_has_the_value_of_the_feedback(self) -> None:
        goal = self.own.invoke("crex", "count_up", {"order": 12})
        seen = [progress["value"] for progress in goal if progress["value"]]
        self.assertTrue(seen)
        self.assertEqual(seen[-1]["sequence"][:4], [0, 1, 1, 2])
        self.assertEqual(len(goal.result().wait(LONG)["sequence"]), 12)

    def test_a_rejected_goal_is_refused(self) -> None:
        goal = self.own.invoke("crex", "count_up", {"order": -1})
        with self.assertRaisesRegex(fipa.Refused, "the action server rejects the goal"):
            goal.accepted().wait(LONG)

    def test_an_aborted_goal_fails_with_its_result(self) -> None:
        goal = self.own.invoke("crex", "count_up", {"order": 13})
        goal.accepted().wait(LONG)
        with self.assertRaisesRegex(fipa.Refused, "has aborted the goal.*sequence"):
            goal.result().wait(LONG)

    def test_a_cancel_reaches_the_server(self) -> None:
        goal = self.own.invoke("crex", "count_up", {"order": 1000})
        next(iter(goal))
        goal.cancel()
        with self.assertRaises(fipa.Cancelled):
            goal.result().wait(LONG)
        until(lambda: ["started", "canceled"] in self.robot.steps().values(), "the cancel")

    def test_a_goal_is_canceled_when_its_client_is_killed(self) -> None:
        before = set(self.robot.steps())
        command = self.site.start("fipa", "do", "crex", "count_up", "order=1001", stdout=subprocess.DEVNULL)
        new = until(lambda: set(self.robot.steps()) - before, "the goal")
        command.kill()
        until(lambda: self.robot.steps()[new.pop()][-1:] == ["canceled"] if len(new) == 1 else True, "the cancel")

    def test_a_goal_that_is_sent_again_runs_once(self) -> None:
        before = set(self.robot.steps())
        first, second = (self.do("--agent", "planner", "--id", "g1", "order=5") for _ in range(2))
        self.assertEqual((first.returncode, second.returncode), (0, 0), first.stderr + second.stderr)
        self.assertEqual(len(set(self.robot.steps()) - before), 1)

    def test_arguments_are_checked(self) -> None:
        for arguments, reason in (
            ({"ordr": 3}, "ordr"),
            ({"order": 2**31}, "order"),
            ({"order": "many"}, "order"),
            ({"order": float("inf")}, ""),
        ):
            with self.subTest(arguments), self.assertRaisesRegex((fipa.Refused, fipa.Invalid), reason):
                self.own.invoke("crex", "count_up", arguments).result().wait(LONG)

    def test_parameters_are_described(self) -> None:
        (action,) = self.own.actions("crex").wait(LONG)
        (order,) = action["parameters"]
        self.assertEqual((order["name"], order["type"]), ("order", "integer"))
        self.assertEqual(order["range"], {"min": -(2.0**31), "max": 2.0**31 - 1})

    def test_a_service_answers_requests(self) -> None:
        answer = self.site.fipa("request", "crex", "(double :int64_value 21)", "--json")
        self.assertEqual(answer.returncode, 0, answer.stderr)
        self.assertIn(":int64_value 42", answer.stdout)
        content = json.dumps({"@": "double", "int64_value": 2**53 + 1, "float64_value": "NaN"})
        letter = self.own.request(fipa.Message("request", "crex", content, language="json")).wait(LONG)
        value = json.loads(letter.text)
        self.assertEqual((value["int64_value"], value["float64_value"]), (2**54 + 2, "NaN"))

    def test_a_wrong_request_is_refused_with_the_reason(self) -> None:
        for content, reason in (
            ("(double :int64 21)", "int64"),
            ("(double :int8_value 200)", "from -128 to 127"),
            ("(triple)", "its services: double"),
            ("((", "expected a service with its arguments"),
            ("(double :int64_value " + "9" * 5000 + ")", "expected a service with its arguments"),
        ):
            with self.subTest(content), self.assertRaisesRegex(fipa.Refused, reason):
                self.own.request(fipa.Message("request", "crex", content)).wait(LONG)

    def test_an_unknown_topic_and_another_protocol_are_answered(self) -> None:
        with self.assertRaisesRegex(fipa.Refused, "no such topic"), self.own.subscribe("crex", "speed") as letters:
            next(letters)
        self.own.send(fipa.Message("query-ref", "crex", "(all ?x (is ?x))")).wait(LONG)
        answer = self.own.receive().wait(LONG)
        self.assertEqual((answer.performative, answer.sender), ("not-understood", "crex"))

    def test_json_that_python_does_not_take_is_answered(self) -> None:
        for content, reason in (
            ('{"@": "double", "string_value": ' + "[" * 100_000, "expected a service with its arguments"),
            ('{"@": "double", "string_value": "\\ud800"}', "surrogates"),
        ):
            with self.subTest(reason), self.assertRaisesRegex(fipa.Refused, reason):
                self.own.request(fipa.Message("request", "crex", content, language="json")).wait(LONG)

    def test_many_requests_at_once_are_answered_and_each_client_has_a_share(self) -> None:
        def begin() -> fipa.Request:
            return self.own.begin_request(fipa.Message("request", "crex", "(double :int64_value 4)"))

        for request in [begin() for _ in range(32)]:
            self.assertIn(":int64_value 8", request.result().wait(LONG).text)
        refused = 0
        for request in [begin() for _ in range(200)]:
            try:
                request.result().wait(LONG)
            except fipa.Refused as error:
                self.assertIn("32 requests of operator wait already", str(error))
                refused += 1
        self.assertLess(refused, 200)

    def test_a_text_of_ten_megabytes_comes_back(self) -> None:
        content = json.dumps({"@": "double", "string_value": "x" * 10_000_000})
        letter = self.own.request(fipa.Message("request", "crex", content, language="json")).wait(LONG)
        self.assertEqual(len(json.loads(letter.text)["string_value"]), 20_000_000)

    def test_a_topic_is_heard_exactly(self) -> None:
        heard = self.site.fipa("subscribe", "crex", "count", "--count", "3", "--json")
        self.assertEqual(heard.returncode, 0, heard.stderr)
        with self.own.subscribe("crex", "count", keep="all") as letters:
            seen = [next(letters) for _ in range(5)]
        numbers = [json.loads(letter.text)["data"] for letter in seen]
        self.assertEqual(numbers, list(range(numbers[0], numbers[0] + 5)))
        self.assertGreater(numbers[0], 2**60)
        self.assertEqual((seen[0].language, seen[0].ontology), ("json", "std_msgs/msg/Int64"))

    def test_a_transient_local_topic_is_latched(self) -> None:
        with self.own.subscribe("crex", "map") as letters:
            self.assertEqual(json.loads(next(letters).text), {"data": "the map"})

    def test_the_directory_lists_the_robot(self) -> None:
        def listed() -> set[str]:
            try:
                found = self.own.search_services(agent="crex").wait(LONG)
            except fipa.Error:
                return set()
            names = {service["name"] for agent in found for service in agent["services"]}
            return names if {"count_up", "double", "count"} <= names else set()

        until(listed, "the listing")


class Lifetimes(unittest.TestCase):
    def setUp(self) -> None:
        self.site = Site()
        self.addCleanup(self.site.close)
        self.domain = fipa.Domain()
        self.addCleanup(self.domain.close)
        self.own = self.domain.register("operator").wait()

    def bridged(self, mapping: str = MAPPING, name: str = "bridge") -> None:
        self.bridge = self.site.bridge(mapping, name=name)
        until(lambda: self.bridge.has_logged("/crex/count_up is "), "the mapping")

    def test_a_goal_ends_as_gone_when_its_server_is_killed(self) -> None:
        robot = self.site.robot("crex")
        self.bridged()
        goal = self.own.invoke("crex", "count_up", {"order": 1000})
        next(iter(goal))
        robot.kill()
        with self.assertRaisesRegex(fipa.Error, "gone"):
            goal.result().wait(LONG)
        self.site.robot("crex")
        until(lambda: self.bridge.log.read_text().count("/crex/count_up is ") == 2, "the return")
        self.assertEqual(len(self.own.invoke("crex", "count_up", {"order": 4}).result().wait(LONG)["sequence"]), 4)

    def test_a_goal_runs_once_although_the_bridge_is_killed(self) -> None:
        robot = self.site.robot("crex")
        self.bridged()
        arguments = ("do", "crex", "count_up", "order=60", "--agent", "planner", "--id", "long", "--json")
        first = self.site.start("fipa", *arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(robot.steps, "the start")
        self.bridge.kill()
        self.assertNotEqual(first.wait(LONG), 0)
        self.bridged(name="again")
        second = self.site.fipa(*arguments)
        self.assertEqual(second.returncode, 0, second.stderr)
        self.assertEqual(list(robot.steps().values()), [["started", "succeeded"]])

    def test_a_goal_goes_on_without_its_client_where_the_mapping_says_so(self) -> None:
        robot = self.site.robot("crex")
        self.bridged(MAPPING + '[settings."/crex/*"]\nclient_gone = "continue"\n')
        command = self.site.start("fipa", "do", "crex", "count_up", "order=80", stdout=subprocess.DEVNULL)
        until(robot.steps, "the start")
        command.kill()
        until(lambda: list(robot.steps().values()) == [["started", "succeeded"]], "the end")

    def test_a_goal_needs_the_fence_where_the_mapping_says_so(self) -> None:
        self.site.robot("crex")
        owner = self.domain.register("door").wait()
        owned = owner.own("passage", volatile=True).wait(LONG)
        self.addCleanup(owned.release)
        self.bridged(MAPPING + '[settings."/crex/count_up"]\nfenced_by = ["door", "passage"]\n')
        with self.assertRaisesRegex(fipa.Refused, "fence"):
            self.own.invoke("crex", "count_up", {"order": 4}).result().wait(LONG)
        with self.own.lock("passage").wait(LONG) as lock:
            self.own.invoke("crex", "count_up", {"order": 4}, lock=lock).result().wait(LONG)

    def test_two_action_servers_of_one_name_get_no_goal(self) -> None:
        self.site.robot("crex")
        self.bridged()
        self.site.robot("crex")

        def refused() -> bool:
            try:
                self.own.invoke("crex", "count_up", {"order": 2}).result().wait(LONG)
            except fipa.Error as error:
                return "more than one action server" in str(error)
            return False

        until(refused, "the refusal")

    def test_two_bridges_do_not_loop(self) -> None:
        self.site.robot("crex")
        arm = self.domain.register("arm_1").wait()
        state = arm.publisher("state", latched=1)
        self.bridged('actions = ["/*"]\ntopics = ["/*"]\n[agents.arm_1.topics]\nstate = "std_msgs/msg/String"\n')
        self.assertTrue(state)
        other = self.site.bridge('topics = ["/*"]\n', name="other")
        until(lambda: other.has_logged("/rosout is not mapped") or other.has_logged("/crex/count is not mapped"), "the look")
        self.assertFalse(other.has_logged("/arm_1/state"))
        self.assertFalse(self.bridge.has_logged("/arm_1/state is topic state of the agent"))

    def test_the_bridge_ends_at_ctrl_c(self) -> None:
        self.site.robot("crex")
        self.bridged()
        self.assertEqual(self.bridge.stop(), 0, self.bridge.log.read_text())
        until(lambda: not [it for it in self.domain.agents() if it["name"] == "crex"], "the end of the agent")


class Graphs(unittest.TestCase):
    """What nodes do to the graph of ROS."""

    def setUp(self) -> None:
        self.site = Site()
        self.addCleanup(self.site.close)
        self.bridge = self.site.bridge('topics = ["/crex/*", "/top"]\n')

    def test_a_publisher_of_another_type_takes_the_place(self) -> None:
        first = self.site.talker("/crex/thing", "std_msgs/String")
        until(lambda: self.bridge.has_logged("/crex/thing is topic"), "the mapping")
        self.site.talker("/crex/thing", "std_msgs/Int64")
        until(lambda: self.bridge.has_logged("/crex/thing has several types"), "the warning")
        first.terminate()
        until(lambda: self.bridge.log.read_text().count("/crex/thing is topic") == 2, "the new mapping")
        with fipa.Domain() as domain:
            with domain.register("viewer").wait().subscribe("crex", "thing") as letters:
                self.assertEqual(next(letters).ontology, "std_msgs/msg/Int64")

    def test_a_publisher_that_returns_with_other_policies_is_heard(self) -> None:
        first = self.site.talker("/crex/thing", "std_msgs/String")
        until(lambda: self.bridge.has_logged("/crex/thing is topic"), "the mapping")
        self.site.talker("/crex/thing", "std_msgs/String", "best_effort")
        first.kill()
        until(lambda: self.bridge.log.read_text().count("/crex/thing is topic") == 2, "the new mapping")
        with fipa.Domain() as domain:
            with domain.register("viewer").wait().subscribe("crex", "thing") as letters:
                self.assertEqual(json.loads(next(letters).text), {"data": ""})

    def test_messages_that_cannot_be_passed_on_do_not_end_a_topic(self) -> None:
        with fipa.Domain() as domain:
            viewer = domain.register("viewer").wait()
            for option, reason in (("large", 'content = "cdr"'), ("broken", "failed to deserialize")):
                name = f"/crex/{option}"
                self.site.talker(name, "std_msgs/String", option)
                self.site.talker(name, "std_msgs/String", "--ros-args", "-r", f"__node:={option}")
                until(lambda name=name: self.bridge.has_logged(f"{name} is topic"), "the mapping")
                with viewer.subscribe("crex", option) as letters:
                    while not self.bridge.has_logged(f"{name}: 0 messages were dropped"):
                        self.assertEqual(json.loads(next(letters).text), {"data": ""})
                    self.assertEqual(json.loads(next(letters).text), {"data": ""})
                self.assertTrue(self.bridge.has_logged(reason))

    def test_a_topic_that_a_bridge_publishes_is_not_mapped(self) -> None:
        self.site.bridge('[agents.crex.topics]\nthing = "std_msgs/msg/String"\n', name="other")
        self.site.talker("/crex/thing", "std_msgs/String")
        until(lambda: self.bridge.has_logged("/crex/thing is published by a bridge, too"), "the warning")

    def test_the_names_of_the_platform_are_not_mapped(self) -> None:
        bridge = self.site.bridge('topics = ["/df/*"]', name="other")
        self.site.talker("/df/thing", "std_msgs/String")
        until(lambda: bridge.has_logged("is the name of an agent of the platform: df"), "the warning")

    def test_topics_of_a_lifecycle_node_are_there_while_it_is_active(self) -> None:
        talker = self.site.talker("/crex/thing", "std_msgs/String", "lifecycle", stdin=subprocess.PIPE)
        self.addCleanup(talker.stdin.close)
        # A node that needs no transition is found after the one that does.
        self.site.talker("/crex/other", "std_msgs/String", "--ros-args", "-r", "__node:=other")
        until(lambda: self.bridge.has_logged("/crex/other is topic"), "the mapping of the other")
        self.assertFalse(self.bridge.has_logged("/crex/thing is topic"))
        for transition, text in (("configure", ""), ("activate", "is topic"), ("deactivate", "has gone")):
            print(transition, file=talker.stdin, flush=True)
            until(lambda text=text: not text or self.bridge.has_logged(f"/crex/thing {text}"), transition)

    def test_a_name_without_a_namespace_needs_a_robot(self) -> None:
        self.site.talker("/top", "std_msgs/String")
        until(lambda: self.bridge.has_logged('/top has no namespace: set `robot = "NAME"`'), "the warning")


class Contents(unittest.TestCase):
    def test_cdr_is_passed_on_without_a_conversion(self) -> None:
        site = Site()
        self.addCleanup(site.close)
        with fipa.Domain() as domain:
            own = domain.register("viewer").wait()
            site.robot("crex")
            bridge = site.bridge('topics = ["/crex/count"]\n[settings."/crex/*"]\ncontent = "cdr"\n')
            until(lambda: bridge.has_logged("/crex/count is "), "the mapping")
            with own.subscribe("crex", "count", keep="all") as letters:
                letter = next(letters)
            self.assertEqual((letter.language, letter.ontology), ("ros2-cdr", "std_msgs/msg/Int64"))
            self.assertGreater(deserialize_message(bytes(letter), Int64).data, 2**60)


class Commands(unittest.TestCase):
    def setUp(self) -> None:
        self.site = Site()
        self.addCleanup(self.site.close)

    def ended(self, mapping: str) -> str:
        bridge = self.site.bridge(mapping)
        self.assertEqual(bridge.process.wait(LONG), 1)
        return bridge.log.read_text()

    def test_mistakes_in_the_mapping_are_named(self) -> None:
        for mapping, text in (
            ('action = ["/crex/x"]', "action is unknown; expected actions, services"),
            ('actions = ["crex/x"]', 'names of ROS begin with "/"'),
            ("actions = [", "bridge.toml"),
            ('[settings."/x"]\ncontent = "xml"', "expected json or cdr, got 'xml'"),
            ('[agents.a.actions]\nmove = "std_msgs/msg/String"', "expected a type PACKAGE/action/NAME"),
            ('[agents.arm-1.topics]\nx = "std_msgs/msg/String"', "ROS has no such name"),
            ('[agents.a.actions]\nmove = "arm_msgs/action/Move"', "source the workspace with the package arm_msgs"),
            ('[agents.a.actions]\nmove = "test_msgs/action/Move"', "the package test_msgs has no action Move"),
        ):
            with self.subTest(mapping):
                self.assertIn(text, self.ended(mapping))

    def test_the_list_is_a_mapping(self) -> None:
        self.site.robot("crex")

        def listed() -> str:
            command = [sys.executable, "-m", "fipa.ros2", "--list"]
            done = subprocess.run(command, env=self.site.environment, capture_output=True, text=True, check=True)
            return done.stdout if "/crex/count_up" in done.stdout else ""

        text = until(listed, "the listing")
        self.assertIn('    "/crex/count",  # std_msgs/msg/Int64\n', text)
        self.assertIn('    # "/crex/robot/set_parameters",', text)
        bridge = self.site.bridge(text)
        until(lambda: bridge.has_logged("/crex/count_up is action"), "the mapping")
        self.assertEqual(bridge.stop(), 0)


if __name__ == "__main__":
    unittest.main()
