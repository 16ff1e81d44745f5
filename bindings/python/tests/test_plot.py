"""The example that needs matplotlib, run as users run it."""

import os
import pathlib
import subprocess
import sys
import tempfile
import unittest
from xml.etree import ElementTree

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"
COUNT = 30


def plot(directory: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    # matplotlib writes a cache.
    environment = {**os.environ, "MPLCONFIGDIR": directory}
    command = [sys.executable, EXAMPLES / "plot_pose.py", *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)


class Plots(unittest.TestCase):
    def setUp(self) -> None:
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.directory = directory.name

    def test_the_picture_has_the_way_of_the_robot(self) -> None:
        robot = subprocess.Popen([sys.executable, "-u", EXAMPLES / "robot.py"], stdout=subprocess.PIPE, text=True)
        self.addCleanup(robot.wait)
        self.addCleanup(robot.kill)
        self.addCleanup(robot.stdout.close)
        self.assertIn("publishing", robot.stdout.readline())
        file = pathlib.Path(self.directory) / "pose.svg"
        plotted = plot(self.directory, "robot", "--save", file, "--count", COUNT)
        self.assertEqual(plotted.returncode, 0, plotted.stderr)
        picture = ElementTree.parse(file)
        lines = [path.get("d", "").count("L") for path in picture.iter("{http://www.w3.org/2000/svg}path")]
        self.assertIn(COUNT - 1, lines)

    def test_without_a_robot_the_plot_says_so(self) -> None:
        file = pathlib.Path(self.directory) / "pose.svg"
        plotted = plot(self.directory, "missing", "--save", file)
        self.assertEqual(plotted.returncode, 1)
        self.assertIn("missing: ", plotted.stderr)
        self.assertNotIn("Traceback", plotted.stderr)
        self.assertFalse(file.exists())


if __name__ == "__main__":
    unittest.main()
