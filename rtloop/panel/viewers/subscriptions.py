"""What a viewer of the Foxglove protocol has subscribed to, by what it says; it can say nothing else."""

from __future__ import annotations

import json
from typing import NamedTuple


class Channel(NamedTuple):
    """As it is advertised."""

    id: int
    topic: str
    schemaName: str
    schema: str
    encoding: str = "cdr"
    schemaEncoding: str = "ros2msg"


class Subscriptions:
    """Of one viewer, to the channels that are advertised to it, `known`."""

    def __init__(self) -> None:
        self.channel_ids: set[int] = set()
        self._channels: dict[int, int] = {}
        """By the number of the subscription."""

    def numbers_for_channel(self, channel: int) -> list[int]:
        """The numbers of the subscriptions to a channel."""
        return [number for number, subscribed_channel in self._channels.items() if subscribed_channel == channel]

    def withdraw(self, channel: int) -> None:
        """It is advertised no longer."""
        self.channel_ids.remove(channel)
        for number in self.numbers_for_channel(channel):
            del self._channels[number]

    def handle_message(self, text: str | None) -> str | None:
        """Do what a message asks for; what is wrong with it."""
        try:
            message = json.loads(text or "")
            match message["op"]:
                case "subscribe":
                    return self._subscribe(
                        [(int(item["id"]), int(item["channelId"])) for item in message["subscriptions"]]
                    )
                case "unsubscribe":
                    for number in message["subscriptionIds"]:
                        self._channels.pop(int(number), None)
                    return None
                case operation:
                    return f"op {str(operation)[:40]!r}: viewers can subscribe and unsubscribe, and change nothing"
        except (ValueError, TypeError, KeyError, RecursionError):
            return "a message that is none of the protocol's"

    def _subscribe(self, requests: list[tuple[int, int]]) -> str | None:
        for number, channel in requests:
            if channel not in self.channel_ids:
                return f"channel {channel}: {', '.join(map(str, sorted(self.channel_ids)))} are advertised"
            if number in self._channels or channel in self._channels.values() or not 0 <= number < 1 << 32:
                return f"subscription {number}: one a channel is allowed, with a number below 2**32 of its own"
            self._channels[number] = channel
        return None
