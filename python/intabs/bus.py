"""LCM from Python: a private group, a check of the route, typed publish and subscribe."""

from __future__ import annotations

import os
import random
import socket
import struct
import time

import lcm

from intabs import messages
from intabs.errors import UserError

GROUP = "239.255.76.67"
ROUTE_CURE = "ip link set lo up; ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo"


def route_fault() -> str | None:
    """Why multicast does not come back to this machine, or None. LCM itself only says so after the programs started."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with receiver, sender:
        receiver.settimeout(0.2)
        payload = os.urandom(16)
        try:
            receiver.bind(("", 0))
            receiver.setsockopt(
                socket.IPPROTO_IP,
                socket.IP_ADD_MEMBERSHIP,
                struct.pack("4sl", socket.inet_aton(GROUP), socket.INADDR_ANY),
            )
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            sender.sendto(payload, (GROUP, receiver.getsockname()[1]))
            until = time.monotonic() + 0.5
            while time.monotonic() < until:
                if receiver.recv(64) == payload:
                    return None
        except TimeoutError:
            pass
        except OSError as e:
            return e.strerror
    return "nothing comes back"


def require_route() -> None:
    fault = route_fault()
    if fault:
        raise UserError(f"no multicast route for LCM ({fault}); run as root: {ROUTE_CURE}")


def private_url() -> str:
    """A group of our own: a random port that nobody on this machine listens to."""
    for _ in range(100):
        port = random.SystemRandom().randrange(20000, 32000)  # below the ephemeral ports
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", port))  # without SO_REUSEADDR, so LCM's own sockets are in the way
            except OSError:
                continue
        return f"udpm://{GROUP}:{port}?ttl=0"
    raise UserError("found no free UDP port from 20000 to 31999")


class Bus:
    """One LCM connection. Handlers get the decoded message; what does not decode is counted."""

    def __init__(self, url: str):
        self._lcm = lcm.LCM(url)
        self.undecodable = 0

    def subscribe(self, channel: str, handler) -> None:
        message_type = messages.CHANNELS[channel]

        def receive(_channel: str, data: bytes) -> None:
            try:
                message = message_type.decode(data)
            except (ValueError, struct.error):
                self.undecodable += 1
                return
            handler(message)

        # 0: no limit. A full queue would keep the oldest messages and lose the newest.
        self._lcm.subscribe(channel, receive).set_queue_capacity(0)

    def publish(self, channel: str, message) -> None:
        self._lcm.publish(channel, message.encode())

    def publish_raw(self, channel: str, data: bytes) -> None:
        self._lcm.publish(channel, data)

    def handle(self, timeout_ms: int) -> bool:
        """Handles everything that has arrived; waits for the first up to `timeout_ms`. False: nothing came."""
        try:
            if self._lcm.handle_timeout(timeout_ms) <= 0:
                return False
            while self._lcm.handle_timeout(0) > 0:
                pass
        except OSError:  # a signal came while it waited; Python's own handler has the say
            return False
        return True
