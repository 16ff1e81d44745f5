"""Plots the pose of a robot while it drives (robot.py), with matplotlib.

    python3 plot_pose.py
    python3 plot_pose.py robot --save pose.svg --count 200

The second command needs no display: it writes the picture after 200 poses, and ends.
"""

import argparse
import json
import math
import sys

import matplotlib
from matplotlib import pyplot

import fipa


# ANCHOR: plot
class Plot:
    """The way of a robot, and an arrow where it is."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.x: list[float] = []
        self.y: list[float] = []
        self.figure, self.axes = pyplot.subplots(figsize=(7, 3.5), layout="constrained")
        self.axes.set(xlabel="x in m", ylabel="y in m")
        self.axes.set_aspect("equal", adjustable="datalim")
        self.axes.margins(0.1)
        self.axes.grid(alpha=0.3)
        (self.way,) = self.axes.plot([], [])
        self.arrow = self.axes.quiver([0], [0], [1], [0], color="tab:red", pivot="mid", scale=20, zorder=3)

    def add(self, pose: fipa.Letter) -> None:
        at = json.loads(pose.text)
        self.x.append(at["x"])
        self.y.append(at["y"])
        self.way.set_data(self.x, self.y)
        self.arrow.set_offsets([[at["x"], at["y"]]])
        self.arrow.set_UVC([math.cos(at["heading"])], [math.sin(at["heading"])])
        self.axes.set_title(f"{self.robot} at {at['x']:.2f}, {at['y']:.2f}")
        self.axes.relim()
        self.axes.autoscale_view()

    def is_open(self) -> bool:
        return pyplot.fignum_exists(self.figure.number)


def show(plot: Plot, poses: fipa.Events[fipa.Letter]) -> None:
    """Shows each pose until the user closes the window, which also works while the robot is lost."""
    while plot.is_open():
        try:
            pose = poses.next().wait(timeout=0.05)
        except fipa.TimedOut:
            pass
        except fipa.Interrupted as error:
            plot.axes.set_title(f"{error}")
        else:
            if pose is None:
                return
            plot.add(pose)
        # Draws, and handles the events of the window.
        pyplot.pause(0.001)
        # ANCHOR_END: plot


def save(plot: Plot, poses: fipa.Events[fipa.Letter], count: int, file: str) -> None:
    for _, pose in zip(range(count), poses):
        plot.add(pose)
    plot.figure.savefig(file)


def main() -> None:
    parser = argparse.ArgumentParser(description="Plots the pose of a robot while it drives.")
    parser.add_argument("robot", nargs="?", default="robot", help="the agent that publishes the topic pose")
    parser.add_argument("--save", metavar="FILE", help="write the picture to this .svg or .png, without a display")
    parser.add_argument("--count", type=int, default=200, help="number of poses in the file (200)")
    chosen = parser.parse_args()
    if chosen.save:
        matplotlib.use("agg")
    try:
        with fipa.Domain() as domain:
            operator = domain.register("operator").wait()
            with operator.subscribe(chosen.robot, "pose") as poses:
                plot = Plot(chosen.robot)
                if chosen.save:
                    save(plot, poses, chosen.count, chosen.save)
                else:
                    show(plot, poses)
    except fipa.Error as error:
        sys.exit(f"{chosen.robot}: {error}")
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
