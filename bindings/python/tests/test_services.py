"""Services in the directory facilitator of a gateway."""

import fipa
from support import Case


class Services(Case):
    def test_a_service_is_found_by_its_parts(self) -> None:
        properties = {"kg": 12.5, "side": "left"}
        self.arm.register_service("lift", "left lift", properties=properties, protocols=["fipa-request"]).wait()
        found = [
            self.rover.search_services("lift").wait(),
            self.rover.search_services(name="left lift").wait(),
            self.rover.search_services(agent=self.arm.name).wait(),
            self.rover.search_services("lift", properties={"side": "left", "kg": None}).wait(),
        ]
        for (description,) in found:
            self.assertEqual(description["name"], self.arm.name)
            (service,) = description["services"]
            self.assertEqual((service["type"], service["name"]), ("lift", "left lift"))
            self.assertEqual((service["properties"], service["protocols"]), (properties, ["fipa-request"]))
        self.assertEqual(self.rover.search_services("lift", properties={"side": "right"}).wait(), [])
        self.assertEqual(self.rover.search_services("dig").wait(), [])

    def test_services_end_with_their_agent_or_before(self) -> None:
        self.arm.register_service("weld").wait()
        self.rover.register_service("weld").wait()
        self.assertEqual(len(self.rover.search_services("weld").wait()), 2)
        self.rover.deregister_services().wait()
        (found,) = self.rover.search_services("weld").wait()
        self.assertEqual(found["services"][0]["name"], "weld")
        with self.assertRaisesRegex(fipa.Refused, "not registered"):
            self.rover.deregister_services().wait()
        self.arm.deregister()
        while self.rover.search_services("weld").wait():
            pass

    def test_wrong_services_are_errors(self) -> None:
        wrong = [
            lambda: self.arm.register_service(5),
            lambda: self.arm.register_service("lift", properties=5),
            lambda: self.arm.register_service("lift", kind="x"),
            lambda: self.arm.register_service("lift", properties={"a": object()}),
            lambda: self.arm.search_services(protocols="fipa-request"),
        ]
        for index, call in enumerate(wrong):
            with self.subTest(index), self.assertRaises((fipa.Invalid, TypeError)):
                call()
