"""A detector: finds the light in the images of a camera (bindings/cpp/examples/camera.cpp) with numpy.

Run the camera, and then the detector, for all images or for a number of them:

    python3 detector.py
    python3 detector.py 300
"""

import itertools
import sys
import time

import numpy

import fipa

WIDTH, HEIGHT = 1280, 800


# ANCHOR: detect
def brightest(content: memoryview) -> tuple[int, int]:
    """Returns the position of the brightest pixel. The array is the memory into which the camera has written."""
    image = numpy.frombuffer(content, dtype=numpy.uint8).reshape(HEIGHT, WIDTH)
    y, x = numpy.unravel_index(image.argmax(), image.shape)
    return int(x), int(y)


def detect(images: fipa.Events[fipa.Letter], count: int | None) -> None:
    missed = 0
    began = time.monotonic()
    for image in itertools.islice(images, count):
        # The memory returns to the camera at the end of the block.
        with image:
            x, y = brightest(image.content)
            missed += image.missed
            print(f"{image.number}: {x}, {y}")
    print(f"{count} images in {time.monotonic() - began:.1f} s, {missed} missed")
    # ANCHOR_END: detect


with fipa.Domain() as domain:
    detector = domain.register("detector").wait()
    try:
        with detector.subscribe("camera", "image") as images:
            detect(images, int(sys.argv[1]) if len(sys.argv) > 1 else None)
    except KeyboardInterrupt:
        pass
    except fipa.Error as error:
        sys.exit(f"camera: {error}")
