// A legacy peer over UDT, with the settings of fipa_services: messages in order, one per letter.
//
//   peer receive ADDRESS PORT [COUNT]
//     Prints "ready PORT", then each message. Port 0 lets the system choose. After COUNT messages it
//     stops reading until a byte arrives on its standard input.
//   peer send ADDRESS PORT
//     Sends each message from its standard input. Prints "ready" when connected, then "sent" after
//     the last message has been acknowledged.
//
//   peer discard ADDRESS PORT
//     Prints "ready PORT" and receives messages.
//   peer flood ADDRESS PORT COUNT
//     Sends the message from its standard input COUNT times. Prints "ready" when connected, then the
//     seconds until all were acknowledged, and the seconds of the processor.
//   peer echo ADDRESS PORT BACK
//     Prints "ready PORT", and sends each message back over a connection of its own to the port BACK.
//   peer ping ADDRESS PORT COUNT
//     Prints "ready PORT". Reads the port of an echo (4 bytes, little-endian) and a message from its
//     standard input, sends the message COUNT times, each after the reply to the one before, and prints
//     the median of the round trips in microseconds.
//
// On the standard streams, a message is its length (4 bytes, little-endian) and its bytes.

#include <arpa/inet.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <udt/udt.h>

namespace {

// Maximum length of a message that is received. A sender may exceed it.
constexpr int most = 10'000'000;
constexpr int most_sent = 11'000'000;

std::mutex output;
long budget = -1;
bool discards = false;

[[noreturn]] void fail(const char* what) {
    std::fprintf(stderr, "%s: %s\n", what, UDT::getlasterror().getErrorMessage());
    // Destructors of libudt may wait for its threads.
    _exit(1);
}

sockaddr_in address(const char* ip, const char* port) {
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(static_cast<uint16_t>(std::atoi(port)));
    inet_pton(AF_INET, ip, &address.sin_addr);
    return address;
}

bool read_exactly(char* to, size_t length) {
    return std::fread(to, 1, length, stdin) == length;
}

void print(const char* bytes, uint32_t length) {
    const unsigned char header[] = {
        static_cast<unsigned char>(length), static_cast<unsigned char>(length >> 8),
        static_cast<unsigned char>(length >> 16), static_cast<unsigned char>(length >> 24)};
    std::lock_guard<std::mutex> lock(output);
    std::fwrite(header, 1, sizeof header, stdout);
    std::fwrite(bytes, 1, length, stdout);
    std::fflush(stdout);
    if (budget > 0 && --budget == 0) {
        // No thread prints, so none reads further, until a byte arrives.
        if (std::getchar() == EOF) {
            _exit(0);
        }
        budget = -1;
    }
}

void receive(UDTSOCKET peer) {
    std::vector<char> buffer(most);
    for (;;) {
        const int length = UDT::recvmsg(peer, buffer.data(), most);
        if (length == UDT::ERROR) {
            UDT::close(peer);
            return;
        }
        if (!discards) {
            print(buffer.data(), static_cast<uint32_t>(length));
        }
    }
}

// Prints "ready PORT".
UDTSOCKET listening(const char* ip, const char* port) {
    const UDTSOCKET server = UDT::socket(AF_INET, SOCK_DGRAM, 0);
    sockaddr_in here = address(ip, port);
    if (UDT::bind(server, reinterpret_cast<sockaddr*>(&here), sizeof here) == UDT::ERROR) {
        fail("bind");
    }
    if (UDT::listen(server, 50) == UDT::ERROR) {
        fail("listen");
    }
    int length = sizeof here;
    if (UDT::getsockname(server, reinterpret_cast<sockaddr*>(&here), &length) == UDT::ERROR) {
        fail("getsockname");
    }
    std::printf("ready %d\n", ntohs(here.sin_port));
    std::fflush(stdout);
    return server;
}

UDTSOCKET accepted(UDTSOCKET server) {
    sockaddr_in from{};
    int size = sizeof from;
    const UDTSOCKET peer = UDT::accept(server, reinterpret_cast<sockaddr*>(&from), &size);
    if (peer == UDT::INVALID_SOCK) {
        fail("accept");
    }
    return peer;
}

int serve(const char* ip, const char* port) {
    const UDTSOCKET server = listening(ip, port);
    for (;;) {
        std::thread(receive, accepted(server)).detach();
    }
}

UDTSOCKET connected(const char* ip, const char* port) {
    const UDTSOCKET peer = UDT::socket(AF_INET, SOCK_DGRAM, 0);
    const sockaddr_in there = address(ip, port);
    if (UDT::connect(peer, reinterpret_cast<const sockaddr*>(&there), sizeof there) == UDT::ERROR) {
        fail("connect");
    }
    return peer;
}

UDTSOCKET announced(UDTSOCKET peer) {
    std::printf("ready\n");
    std::fflush(stdout);
    return peer;
}

// Reads a message. Returns its length, or 0 at the end.
uint32_t next(std::vector<char>& buffer) {
    unsigned char header[4];
    if (!read_exactly(reinterpret_cast<char*>(header), sizeof header)) {
        return 0;
    }
    const uint32_t length = header[0] | header[1] << 8 | header[2] << 16 |
                            static_cast<uint32_t>(header[3]) << 24;
    return length <= buffer.size() && read_exactly(buffer.data(), length) ? length : 0;
}

void send_one(UDTSOCKET peer, const std::vector<char>& buffer, uint32_t length) {
    const int sent = UDT::sendmsg(peer, buffer.data(), static_cast<int>(length), -1, true);
    if (sent != static_cast<int>(length)) {
        fail("sendmsg");
    }
}

double seconds(clockid_t clock) {
    timespec time{};
    clock_gettime(clock, &time);
    return static_cast<double>(time.tv_sec) + static_cast<double>(time.tv_nsec) * 1e-9;
}

int flood(const char* ip, const char* port, long count) {
    const UDTSOCKET peer = announced(connected(ip, port));
    std::vector<char> buffer(most);
    const uint32_t length = next(buffer);
    const double begun = seconds(CLOCK_MONOTONIC);
    const double processor = seconds(CLOCK_PROCESS_CPUTIME_ID);
    for (long sent = 0; sent < count; ++sent) {
        send_one(peer, buffer, length);
    }
    UDT::close(peer);
    std::printf("%f %f\n", seconds(CLOCK_MONOTONIC) - begun,
                seconds(CLOCK_PROCESS_CPUTIME_ID) - processor);
    std::fflush(stdout);
    return 0;
}

int echo(const char* ip, const char* port, const char* back) {
    const UDTSOCKET in = accepted(listening(ip, port));
    const UDTSOCKET out = connected(ip, back);
    std::vector<char> buffer(most);
    for (;;) {
        const int length = UDT::recvmsg(in, buffer.data(), most);
        if (length == UDT::ERROR) {
            return 0;
        }
        send_one(out, buffer, static_cast<uint32_t>(length));
    }
}

int ping(const char* ip, const char* port, long count) {
    const UDTSOCKET server = listening(ip, port);
    unsigned char there[4];
    if (!read_exactly(reinterpret_cast<char*>(there), sizeof there)) {
        return 2;
    }
    const UDTSOCKET out = connected(ip, std::to_string(there[0] | there[1] << 8).c_str());
    std::vector<char> buffer(most);
    std::vector<char> reply(most);
    const uint32_t length = next(buffer);
    send_one(out, buffer, length);
    const UDTSOCKET in = accepted(server);
    std::vector<double> trips;
    for (long sent = 0; sent <= count; ++sent) {
        const double begun = seconds(CLOCK_MONOTONIC);
        if (sent > 0) {
            send_one(out, buffer, length);
        }
        if (UDT::recvmsg(in, reply.data(), most) != static_cast<int>(length)) {
            fail("recvmsg");
        }
        // The first message also waits for the connection of the echo.
        if (sent > 0) {
            trips.push_back(seconds(CLOCK_MONOTONIC) - begun);
        }
    }
    std::sort(trips.begin(), trips.end());
    std::printf("%f\n", trips[trips.size() / 2] * 1e6);
    std::fflush(stdout);
    return 0;
}

int send(const char* ip, const char* port) {
    const UDTSOCKET peer = announced(connected(ip, port));
    std::vector<char> buffer(most_sent);
    while (const uint32_t length = next(buffer)) {
        send_one(peer, buffer, length);
    }
    // Waits until everything is acknowledged.
    UDT::close(peer);
    std::printf("sent\n");
    std::fflush(stdout);
    return 0;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc < 4) {
        return 2;
    }
    UDT::startup();
    discards = std::strcmp(argv[1], "discard") == 0;
    if (discards || std::strcmp(argv[1], "receive") == 0) {
        budget = argc > 4 ? std::atol(argv[4]) : -1;
        return serve(argv[2], argv[3]);
    }
    const auto is = [&](const char* what) { return argc > 4 && std::strcmp(argv[1], what) == 0; };
    const int code = is("flood")  ? flood(argv[2], argv[3], std::atol(argv[4]))
                     : is("echo") ? echo(argv[2], argv[3], argv[4])
                     : is("ping") ? ping(argv[2], argv[3], std::atol(argv[4]))
                                  : send(argv[2], argv[3]);
    UDT::cleanup();
    return code;
}
