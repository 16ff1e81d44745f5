"""An end of a path in Python; `fipa bench languages` starts two for each mechanism.

`ends.py MECHANISM END DOMAIN PLACE LARGEST [ADDRESS]`: orders come on standard input and events go to standard output,
as those of `part/orders.rs`. A function per mechanism returns the address of its end and the step of that end. The step
of a sender copies a content into the memory of the mechanism and returns the answer. The step of a receiver answers one
message with the first and the last byte of its content. `ends.py versions` prints what this Python can import.
"""

import asyncio
import contextlib
import functools
import importlib.metadata
import json
import os
import select
import sys
import threading
import time
from multiprocessing import connection, resource_tracker

# A content of this length is written into memory of the mechanism, and a shorter one is passed as bytes.
LARGE = 4096

# What an end does when its orders have ended.
endings = []


def probe(content):
    return bytes((content[0], content[-1]))


def fipa_agent(end, domain):
    import fipa

    settings = {"domain": domain, "mts.transports": "shm", "discovery.mdns": False}
    opened = fipa.Domain(settings=settings)
    endings.append(opened.close)
    return fipa, opened.register(f"{end}-{os.getpid()}").wait()


def python(end, domain, place, largest, to):
    fipa, agent = fipa_agent(end, domain)
    request = fipa.Message("request", to)

    def send(content):
        if len(content) < LARGE:
            agent.send(fipa.Message("request", to, content)).wait()
        else:
            loan = agent.loan(request, len(content))
            with memoryview(loan) as view:
                view[:] = content
            loan.send().wait()
        with agent.receive().wait() as letter:
            return bytes(letter)

    def receive():
        with agent.receive().wait() as letter:
            agent.answer(letter, fipa.Message("inform", content=probe(letter.content))).wait()

    return agent.name, send if end == "sender" else receive


def python_asyncio(end, domain, place, largest, to):
    fipa, agent = fipa_agent(end, domain)
    request = fipa.Message("request", to)

    async def send(content):
        if len(content) < LARGE:
            await agent.send(fipa.Message("request", to, content))
        else:
            loan = agent.loan(request, len(content))
            with memoryview(loan) as view:
                view[:] = content
            await loan.send()
        async with agent.receive() as letter:
            return bytes(letter)

    async def receive():
        async with agent.receive() as letter:
            await agent.answer(letter, fipa.Message("inform", content=probe(letter.content)))

    return agent.name, send if end == "sender" else receive


def connected(end, place, to, name):
    """A connection as `multiprocessing.Pipe` has two, between processes that were not forked from each other."""
    if end == "sender":
        found = connection.Client(to, "AF_UNIX")
        return to, lambda: found
    listener = connection.Listener(os.path.join(place, name), "AF_UNIX")
    return listener.address, functools.cache(listener.accept)


def pipe(end, domain, place, largest, to):
    address, found = connected(end, place, to, "pipe")

    def send(content):
        found().send_bytes(content)
        return found().recv_bytes()

    def receive():
        found().send_bytes(probe(found().recv_bytes()))

    return address, send if end == "sender" else receive


def shared_memory(end, domain, place, largest, to):
    from multiprocessing.shared_memory import SharedMemory

    # The measurement removes the file.
    resource_tracker.register = lambda *_: None
    memory = SharedMemory(f"fipa_{domain}-memory", create=end == "receiver", size=largest)
    address, found = connected(end, place, to, "memory")

    def send(content):
        memory.buf[: len(content)] = content
        found().send_bytes(len(content).to_bytes(8, "little"))
        return found().recv_bytes()

    def receive():
        length = int.from_bytes(found().recv_bytes(), "little")
        found().send_bytes(bytes((memory.buf[0], memory.buf[length - 1])))

    return address, send if end == "sender" else receive


def zenoh(end, domain, place, largest, to):
    import zenoh

    is_sender = end == "sender"
    address = to or f"unixsock-stream/{place}/zenoh"
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [] if is_sender else [address],
        "connect/endpoints": [address] if is_sender else [],
        "transport/shared_memory/enabled": True,
    }.items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    incoming = session.declare_subscriber("answer" if is_sender else "ask")
    outgoing = session.declare_publisher(
        "ask" if is_sender else "answer",
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )
    provider = zenoh.shm.ShmProvider.default_backend(4 * largest + (1 << 20))
    policy = zenoh.shm.BlockOn(zenoh.shm.GarbageCollect())
    while is_sender and not outgoing.matching_status.matching:
        time.sleep(0.01)

    def send(content):
        if len(content) < LARGE:
            outgoing.put(bytes(content))
        else:
            memory = provider.alloc(len(content), policy=policy)
            memory[:] = content
            outgoing.put(memory)
        return bytes(incoming.recv().payload)

    def receive():
        # The package gives access to a content only by a copy.
        outgoing.put(probe(bytes(incoming.recv().payload)))

    endings.extend((remove_zenoh_files, session.close))
    return address, send if is_sender else receive


def remove_zenoh_files():
    """Removes the files of this process in shared memory. zenoh leaves some to the next process that starts."""
    with open("/proc/self/maps") as maps:
        files = {line.split()[-1] for line in maps if line.endswith(".zenoh\n")}
    for file in files:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(file)


def iceoryx2(end, domain, place, largest, to):
    import ctypes

    import iceoryx2 as iox2

    iox2.set_log_level(iox2.LogLevel.Error)
    config = iox2.config.default()
    config.global_cfg.prefix = iox2.FileName.new(f"fipa_{domain}-")
    config.global_cfg.root_path = iox2.Path.new(place)
    node = iox2.NodeBuilder.new().config(config).create(iox2.ServiceType.Ipc)

    def service(name):
        builder = node.service_builder(iox2.ServiceName.new(name))
        messages = builder.publish_subscribe(iox2.Slice[ctypes.c_uint8]).open_or_create()
        return messages, node.service_builder(iox2.ServiceName.new(name)).event().open_or_create()

    ask, answer = service("ask"), service("answer")
    (out, out_event), (back, back_event) = (ask, answer) if end == "sender" else (answer, ask)
    subscriber, listener = back.subscriber_builder().create(), back_event.listener_builder().create()
    publisher = out.publisher_builder().initial_max_slice_len(largest).create()
    notifier = out_event.notifier_builder().create()

    def publish(content):
        sample = publisher.loan_slice_uninit(len(content))
        ctypes.memmove(sample.payload_ptr, content, len(content))
        sample.assume_init().send()
        notifier.notify()

    def take():
        while (sample := subscriber.receive()) is None:
            listener.blocking_wait()
        content = sample.payload()
        taken = bytes((content[0], content[content.len() - 1]))
        sample.delete()
        return taken

    def send(content):
        publish((ctypes.c_char * len(content)).from_buffer(content))
        return take()

    return "", send if end == "sender" else lambda: publish(take())


def rclpy(end, domain, place, largest, to):
    import array

    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import UInt8MultiArray

    rclpy.init()
    name = domain.replace("-", "_")
    node = rclpy.create_node(f"{name}_{end}")
    topics = [f"{name}_ask", f"{name}_answer"]
    out, back = topics if end == "sender" else reversed(topics)
    taken = []
    node.create_subscription(UInt8MultiArray, back, lambda message: taken.append(message.data), 10)
    publisher = node.create_publisher(UInt8MultiArray, out, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def take():
        while not taken:
            executor.spin_once()
        return taken.pop()

    def publish(content):
        # The message is memory of the process, which rclpy converts and copies.
        publisher.publish(UInt8MultiArray(data=array.array("B", content)))

    def send(content):
        publish(content)
        return bytes(take())

    while end == "sender" and (publisher.get_subscription_count() == 0 or node.count_publishers(back) == 0):
        executor.spin_once(timeout_sec=0.01)
    return "", send if end == "sender" else lambda: publish(probe(take()))


MECHANISMS = {
    "python": python,
    "python_asyncio": python_asyncio,
    "pipe": pipe,
    "shared_memory": shared_memory,
    "zenoh": zenoh,
    "iceoryx2": iceoryx2,
    "rclpy": rclpy,
}


async def sent(step, letters):
    began, ended = [], []
    content = bytearray(letters["size"])
    for number in range(letters["count"]):
        content[0] = content[-1] = number % 256
        began.append(time.monotonic_ns())
        answer = step(content)
        if asyncio.iscoroutine(answer):
            answer = await answer
        ended.append(time.monotonic_ns())
        if answer != probe(content):
            raise ValueError(f"message {number} was answered with {answer!r}")
    return {"event": "sent", "began": began, "ended": ended}


async def received(step, letters):
    at = []
    for _ in range(letters["count"]):
        answered = step()
        if asyncio.iscoroutine(answered):
            await answered
        at.append(time.monotonic_ns())
    return {"event": "received", "at": at}


def say(event):
    print(json.dumps(event), flush=True)


def end_with_orders():
    # Also while the main thread waits for a message that never comes.
    watched = select.poll()
    watched.register(0, 0)
    watched.poll()
    time.sleep(1)
    os._exit(0)


def execute_orders(mechanism, end, domain, place, largest, to=None):
    threading.Thread(target=end_with_orders, daemon=True).start()
    address, step = MECHANISMS[mechanism](end, domain, place, int(largest), to)
    say({"event": "ready", "address": address})
    loop = asyncio.new_event_loop()
    endings.append(loop.close)
    for line in sys.stdin:
        letters = json.loads(line)
        before = time.process_time_ns()
        if letters["do"] == "receive":
            say({"event": "receiving"})
        turn = sent if letters["do"] == "send" else received
        event = loop.run_until_complete(turn(step, letters))
        say(event | {"cpu_ns": time.process_time_ns() - before})
    for ending in endings:
        ending()


def versions():
    packages = {}
    for module, package in {"fipa": "fipa", "zenoh": "eclipse-zenoh", "iceoryx2": "iceoryx2", "rclpy": "rclpy"}.items():
        try:
            importlib.import_module(module)
            packages[module] = {"version": importlib.metadata.version(package)}
        except importlib.metadata.PackageNotFoundError:
            packages[module] = {"version": "of unknown version"}
        except ImportError as error:
            packages[module] = {"missing": str(error)}
    print(json.dumps({"python": sys.version.split()[0], "packages": packages}))


if sys.argv[1:] == ["versions"]:
    versions()
else:
    try:
        execute_orders(*sys.argv[1:])
    except Exception as error:
        say({"event": "failed", "what": f"{sys.argv[1]}: {type(error).__name__}: {error}"})
        sys.exit(1)
