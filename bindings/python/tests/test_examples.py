"""The examples, run as users run them."""

import pathlib
import signal
import subprocess
import sys
import unittest

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"


class Examples(unittest.TestCase):
    def test_the_rover_asks_the_arm(self) -> None:
        arm = subprocess.Popen(
            [sys.executable, "-u", EXAMPLES / "arm.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.addCleanup(arm.kill)
        self.assertIn("serving", arm.stdout.readline())
        rover = subprocess.run([sys.executable, EXAMPLES / "rover.py"], capture_output=True, text=True, timeout=120)
        self.assertEqual(rover.returncode, 0, rover.stderr)
        self.assertIn("lifted crate\n", rover.stdout)
        self.assertIn("moved 1.5 m\n", rover.stdout)
        arm.send_signal(signal.SIGINT)
        out, errors = arm.communicate(timeout=60)
        self.assertEqual((arm.returncode, errors), (0, ""))

    def test_without_an_arm_the_rover_says_so(self) -> None:
        rover = subprocess.run([sys.executable, EXAMPLES / "rover.py"], capture_output=True, text=True, timeout=120)
        self.assertEqual(rover.returncode, 1)
        self.assertIn("arm_1: ", rover.stderr)
        self.assertNotIn("Traceback", rover.stderr)


if __name__ == "__main__":
    unittest.main()
