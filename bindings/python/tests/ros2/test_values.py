"""Messages of ROS as values of JSON: a test for each row of the table in `fipa.ros2.values`."""

import base64
import json
import math
import unittest
from typing import Any

from test_msgs.msg import Arrays, BasicTypes, BoundedSequences, Constants, Defaults, Empty, MultiNested, Strings, WStrings
from test_msgs.msg import UnboundedSequences

from fipa.ros2.values import Mismatch, UnknownType, from_json, load, name_of, to_json


class Values(unittest.TestCase):
    def same(self, message: Any) -> dict[str, Any]:
        """Writes and reads a message, and returns what was written."""
        written = json.loads(json.dumps(to_json(message), allow_nan=False))
        self.assertEqual(repr(from_json(type(message), written)), repr(message))
        return written

    def wrong(self, kind: Any, value: Any, text: str) -> None:
        with self.assertRaisesRegex(Mismatch, text):
            from_json(kind, value)

    def test_booleans(self) -> None:
        self.assertIs(self.same(BasicTypes(bool_value=True))["bool_value"], True)
        self.wrong(BasicTypes, {"bool_value": 1}, "bool_value: expected true or false, got 1")

    def test_integers_are_exact(self) -> None:
        for name, least, greatest in (
            ("int8_value", -(2**7), 2**7 - 1),
            ("uint16_value", 0, 2**16 - 1),
            ("int64_value", -(2**63), 2**63 - 1),
            ("uint64_value", 0, 2**64 - 1),
            ("char_value", 0, 255),
        ):
            for number in (least, greatest):
                self.assertEqual(self.same(BasicTypes(**{name: number}))[name], number)
            for number in (least - 1, greatest + 1, 0.5, True, "1", math.inf, math.nan):
                self.wrong(BasicTypes, {name: number}, f"{name}: expected an integer from {least} to {greatest}")
        self.assertEqual(self.same(BasicTypes(byte_value=b"\xff"))["byte_value"], 255)

    def test_numbers(self) -> None:
        self.assertEqual(self.same(BasicTypes(float64_value=0.1))["float64_value"], 0.1)
        for number, text in ((math.nan, "NaN"), (math.inf, "Infinity"), (-math.inf, "-Infinity")):
            self.assertEqual(self.same(BasicTypes(float64_value=number))["float64_value"], text)
        for value in ("fast", None, True, [], 10**400):
            self.wrong(BasicTypes, {"float64_value": value}, "float64_value: expected a")
        self.wrong(BasicTypes, {"float32_value": 1e39}, "float32_value: expected a finite number")

    def test_texts(self) -> None:
        self.same(Strings(string_value='ä "b" \\'))
        self.same(WStrings(wstring_value="äöü"))
        self.wrong(Strings, {"string_value": 5}, "string_value: expected a text")
        self.wrong(Strings, {"bounded_string_value": "x" * 23}, "a text of at most 22 characters")

    def test_bytes_are_base64(self) -> None:
        message = UnboundedSequences(uint8_values=[0, 255], byte_values=[b"\x00", b"\xff"])
        written = self.same(message)
        self.assertEqual(written["uint8_values"], base64.b64encode(b"\x00\xff").decode())
        self.assertEqual(list(from_json(UnboundedSequences, {"uint8_values": [1, 2]}).uint8_values), [1, 2])
        self.wrong(UnboundedSequences, {"uint8_values": "?"}, "uint8_values: expected a text in base64")

    def test_arrays_and_sequences(self) -> None:
        self.same(Arrays(int32_values=[1, 2, 3]))
        self.same(BoundedSequences(int32_values=[1]))
        self.wrong(Arrays, {"int32_values": [1]}, "int32_values: expected a list of 3 elements")
        self.wrong(BoundedSequences, {"int32_values": [1] * 4}, "a list of at most 3 elements")
        self.wrong(Arrays, {"int32_values": [1, "x", 3]}, r"int32_values\[1\]: expected an integer")
        self.wrong(Arrays, {"int32_values": 1}, "int32_values: expected a list")

    def test_messages(self) -> None:
        self.same(MultiNested())
        self.same(Constants())
        self.assertEqual(self.same(Empty()), {})
        self.wrong(Arrays, {"basic_types_values": [{"int8_value": 1000}] * 3}, r"basic_types_values\[0\]\.int8_value")
        self.wrong(Arrays, [], "the message: expected an object")
        self.wrong(Empty, {"x": 1}, "x: expected a field of none")

    def test_what_is_missing_has_its_default(self) -> None:
        self.assertEqual(from_json(Defaults, {}).int32_value, Defaults().int32_value)
        self.assertNotEqual(Defaults().int32_value, 0)

    def test_unknown_types_name_the_package(self) -> None:
        for name, text in (
            ("nav2_msgs/action/NavigateToPose", "source the workspace with the package nav2_msgs"),
            ("std_msgs/msg/Strin", "the package std_msgs has no msg Strin"),
            ("std_msgs/String", "is no type: expected"),
            ("../os/msg/x", "is no type"),
        ):
            with self.assertRaisesRegex(UnknownType, text):
                load(name)
        self.assertIs(load("test_msgs/msg/Empty"), Empty)
        self.assertEqual(name_of(Empty), "test_msgs/msg/Empty")


if __name__ == "__main__":
    unittest.main()
