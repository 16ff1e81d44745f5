/* A camera, the agent `camera`, which publishes 30 images per second as the topic `image`. It
 * writes each image into memory that subscribers on this host read in place. Ends with SIGINT or
 * SIGTERM.
 *
 *   c++ -std=c++17 camera.cpp $(pkg-config --cflags --libs fipa) -o camera && ./camera
 *   python3 ../../python/examples/detector.py
 */

#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <thread>

#include "fipa.hpp"

using namespace std::chrono_literals;

/* An image has one byte per pixel, row after row. */
constexpr int width = 1280, height = 800;

struct position {
  int x, y;
};

/* Returns the position of a light that moves on an eight, once in ten seconds. */
static position light_at(std::uint64_t frame) {
  const double angle = 2.0 * 3.14159265358979 * static_cast<double>(frame) / 300.0;
  return {static_cast<int>(std::lround(width / 2 + 0.4 * width * std::cos(angle))),
          static_cast<int>(std::lround(height / 2 + 0.4 * height * std::sin(2.0 * angle)))};
}

/* Takes an image: a spot in the dark, which is brightest in its center. */
static void expose(std::byte* image, position light) {
  constexpr int dark = 16, bright = 255, radius = 20, area = radius * radius;
  std::memset(image, dark, std::size_t{width} * height);
  for (int y = -radius; y <= radius; y++) {
    for (int x = -radius; x <= radius; x++) {
      const int square = x * x + y * y;
      if (square > area) continue;
      const int value = dark + (bright - dark) * (area - square) / area;
      image[(light.y + y) * width + light.x + x] = static_cast<std::byte>(value);
    }
  }
}

static volatile std::sig_atomic_t stopped;

int main() {
  std::signal(SIGINT, [](int) { stopped = 1; });
  std::signal(SIGTERM, [](int) { stopped = 1; });
  // Each line is printed at once, also into a pipe.
  std::setvbuf(stdout, nullptr, _IOLBF, BUFSIZ);
  try {
    const auto domain = fipa::domain::open().value();
    const auto agent = domain.add_agent("camera", {"camera", "1280 x 800 gray pixels"}).value();
    // ANCHOR: publish
    const auto images = agent.publisher({"image", "application/octet-stream", 30.0}).value();
    auto due = std::chrono::steady_clock::now();
    for (std::uint64_t frame = 1; !stopped; frame++) {
      const position light = light_at(frame);
      std::printf("%llu: %d, %d\n", static_cast<unsigned long long>(frame), light.x, light.y);
      fipa::notification_loan image = images.loan(std::size_t{width} * height).value();
      expose(image.data(), light);
      image.publish().value();
      due += std::chrono::nanoseconds(1s) / 30;
      std::this_thread::sleep_until(due);
    }
    // ANCHOR_END: publish
  } catch (const fipa::failure& failure) {
    std::fprintf(stderr, "camera: %s\n", failure.what());
    return 1;
  }
  return 0;
}
