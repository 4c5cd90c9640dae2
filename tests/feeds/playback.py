#!/usr/bin/env python3
"""Plays a session by foxglove.sdk.v1 with playback control, as the Foxglove app does.

    python tests/feeds/playback.py URL SESSION.mcap [MORE.mcap ...]

The files are those of the session. The playback messages are packed and read by the structs of robo-ws-bridge, a
server of the protocol that others wrote; messages are held against those of the files as the package mcap reads them.
Exit code 0 if all is as it should be, 1 with a message for what is not.
"""

import asyncio
import json
import struct
import sys

import websockets
from mcap.reader import make_reader
from mcap_ros2._dynamic import generate_dynamic
from robo_ws_bridge.server import _PLAYBACK_CONTROL_HEADER, _PLAYBACK_STATE_HEADER
from robo_ws_bridge.ws_types import BinaryOpCodes, PlaybackStatus

PLAY, PAUSE = 0, 1
MADE_HERE = ("/tf", "/location", "/log")


def recorded(paths):
    """What is in the files: (log time, topic, bytes) without the journal; and all log times."""
    messages, times = [], []
    for path in paths:
        with open(path, "rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages(log_time_order=False):
                times.append(message.log_time)
                if not channel.topic.endswith("/journal"):
                    messages.append((message.log_time, channel.topic, message.data))
    return messages, times


class Client:
    def __init__(self, socket):
        self.socket = socket
        self.topics = {}
        self.decoders = {}
        self.info = None
        self.messages = []
        self.times = []
        self.states = []
        self.requests = 0

    async def hear(self, until):
        """Takes messages until the condition holds."""
        async with asyncio.timeout(30):
            while not until():
                self.take(await self.socket.recv())

    def take(self, message):
        if isinstance(message, str):
            said = json.loads(message)
            if said["op"] == "serverInfo":
                self.info = said
            elif said["op"] == "advertise":
                for channel in said["channels"]:
                    self.topics[channel["id"]] = channel["topic"]
                    if channel["encoding"] == "cdr":
                        decoders = generate_dynamic(channel["schemaName"], channel["schema"])
                        self.decoders[channel["topic"]] = decoders[channel["schemaName"]]
            else:
                sys.exit(f"unexpected: {said}")
        elif message[0] == BinaryOpCodes.MESSAGE_DATA.value:
            subscription, time = struct.unpack_from("<IQ", message, 1)
            self.messages.append((time, self.topics[subscription], message[13:]))
        elif message[0] == BinaryOpCodes.TIME.value:
            self.times.append(struct.unpack_from("<Q", message, 1)[0])
        else:
            header = _PLAYBACK_STATE_HEADER
            _, status, time, speed, did_seek, length = header.unpack_from(message)
            request = message[header.size : header.size + length].decode()
            assert len(message) == header.size + length
            self.states.append((PlaybackStatus(status), time, speed, bool(did_seek), request))

    async def ask(self, command, speed, seek=None):
        """A request, and the state that answers it."""
        self.requests += 1
        name = f"request {self.requests}"
        header = _PLAYBACK_CONTROL_HEADER.pack(command, speed, seek is not None, seek or 0, len(name))
        await self.socket.send(bytes([BinaryOpCodes.PLAYBACK_CONTROL_REQUEST.value]) + header + name.encode())
        await self.hear(lambda: self.states and self.states[-1][4] == name)
        return self.states[-1]

    async def subscribe(self):
        # The subscription has the number of its channel.
        wanted = [{"id": channel, "channelId": channel} for channel in self.topics]
        await self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def expect(condition, *what):
    if not condition:
        sys.exit(" ".join(str(one)[:2000] for one in what))


async def check(url, paths):
    expected, times = recorded(paths)
    start, end = min(times), max(times)
    async with websockets.connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        expect(socket.subprotocol == "foxglove.sdk.v1", "another sub-protocol:", socket.subprotocol)
        client = Client(socket)
        await client.hear(lambda: client.info and client.topics and client.states)
        nanos = lambda time: time["sec"] * 1_000_000_000 + time["nsec"]
        expect("playbackControl" in client.info["capabilities"], client.info)
        expect(nanos(client.info["dataStartTime"]) == start, "starts elsewhere:", client.info, start)
        expect(nanos(client.info["dataEndTime"]) == end, "ends elsewhere:", client.info, end)
        expect(client.states[0][0] == PlaybackStatus.PLAYING, client.states)
        topics = {topic for _, topic, _ in expected}
        shown = {topic for topic in client.topics.values() if not topic.endswith(MADE_HERE)}
        expect(shown == topics, "other topics:", shown ^ topics)

        # From the beginning, with everything subscribed to: every message, in order, to the byte.
        await client.ask(PAUSE, 1.0)
        await client.subscribe()
        state = await client.ask(PLAY, 50.0, start)
        expect(state[0] == PlaybackStatus.PLAYING and state[1] == start and state[2] == 50.0 and state[3], state)
        client.messages.clear()
        await client.hear(lambda: client.states[-1][0] == PlaybackStatus.ENDED)
        # Answers overtake messages.
        sent = lambda: [one for one in client.messages if not one[1].endswith(MADE_HERE)]
        await client.hear(lambda: len(sent()) >= len(expected) and client.times[-1] == end)
        expect(sent() == expected, "other messages than recorded:", len(sent()), len(expected))
        for time, topic, data in client.messages:
            if topic in client.decoders:
                client.decoders[topic](data)
        made = {topic for _, topic, _ in client.messages if topic.endswith(MADE_HERE)}
        machines = {topic.split("/")[1] for topic in topics}
        expect(made == {f"/{machine}{one}" for machine in machines for one in MADE_HERE}, "made:", made)

        # Into the middle: nothing from before it, then what comes after it, as fast as asked.
        middle = (start + end) // 2
        state = await client.ask(PAUSE, 2.0, middle)
        expect(state[:4] == (PlaybackStatus.PAUSED, middle, 2.0, True), state)
        client.messages.clear()
        client.times.clear()
        try:
            async with asyncio.timeout(0.5):
                await client.hear(lambda: client.messages)
            sys.exit("messages while it is paused")
        except TimeoutError:
            pass
        expect(all(time == middle for time in client.times), "time goes on in the pause:", client.times)
        loop = asyncio.get_running_loop()
        begun = loop.time()
        await client.ask(PLAY, 2.0)
        await client.hear(lambda: client.messages and client.messages[-1][0] >= middle + 3_000_000_000)
        took = loop.time() - begun
        expect(1.3 < took < 4.0, "3 s at twice the speed took", took)
        rest = [one for one in expected if one[0] >= middle]
        expect(sent() == rest[: len(sent())], "other messages than recorded from the middle")

        # What is over is played again.
        state = await client.ask(PLAY, 100.0, end)
        await client.hear(lambda: client.states[-1][0] == PlaybackStatus.ENDED)
        state = await client.ask(PLAY, 100.0)
        expect(state[1] == start and state[3], state)
        client.messages.clear()
        await client.hear(lambda: client.messages)
        expect(client.messages[0][0] < middle, client.messages[0][0], middle)
    print(f"{len(expected)} messages of {len(topics)} topics")


asyncio.run(check(sys.argv[1], sys.argv[2:]))
