"""Subscriptions of a viewer of the Foxglove protocol, and the messages that change them."""

from __future__ import annotations

import json
from typing import NamedTuple


class Channel(NamedTuple):
    """A channel with the keys of its advertisement."""

    id: int
    topic: str
    schemaName: str
    schema: str
    encoding: str = "cdr"
    schemaEncoding: str = "ros2msg"


class Subscriptions:
    """Subscriptions of one viewer to the advertised channels, `channel_ids`."""

    def __init__(self) -> None:
        """Begin without advertised channels and without subscriptions."""
        self.channel_ids: set[int] = set()
        self._channels: dict[int, int] = {}
        """Channel by the number of the subscription."""

    def numbers_for_channel(self, channel: int) -> list[int]:
        """Return the numbers of the subscriptions to the channel with the id `channel`."""
        return [number for number, subscribed_channel in self._channels.items() if subscribed_channel == channel]

    def withdraw(self, channel: int) -> None:
        """Remove the channel with the id `channel`, which is no longer advertised, and all subscriptions to it.

        Raises KeyError for a channel that was not advertised.
        """
        self.channel_ids.remove(channel)
        for number in self.numbers_for_channel(channel):
            del self._channels[number]

    def handle_message(self, text: str | None) -> str | None:
        """Carry out the JSON message of a viewer, subscribe or unsubscribe; unknown subscriptions to end are ignored.

        Returns the fault of an invalid message as a sentence, else None; `text` None is invalid.
        """
        try:
            message = json.loads(text or "")
            match message["op"]:
                case "subscribe":
                    requests = [(int(item["id"]), int(item["channelId"])) for item in message["subscriptions"]]
                    return self._subscribe(requests)
                case "unsubscribe":
                    for number in message["subscriptionIds"]:
                        self._channels.pop(int(number), None)
                    return None
                case operation:
                    return f"op {str(operation)[:40]!r}: unknown; allowed: subscribe, unsubscribe"
        except (ValueError, TypeError, KeyError, RecursionError):
            return "message: not valid in the Foxglove protocol; allowed: subscribe, unsubscribe"

    def _subscribe(self, requests: list[tuple[int, int]]) -> str | None:
        """Add subscriptions, (number, channel id) each, up to the first invalid one.

        A subscription is invalid if its channel is not advertised or has one already, or if its number is in use or has
        more than 32 bits. Returns the fault of the first invalid one, None if all are valid.
        """
        for number, channel in requests:
            if channel not in self.channel_ids:
                return f"channel {channel}: unknown; allowed: {', '.join(map(str, sorted(self.channel_ids)))}"
            if number in self._channels or channel in self._channels.values() or not 0 <= number < 1 << 32:
                return (
                    f"subscription {number} to channel {channel}: refused; allowed: one subscription for each channel, "
                    "with an unused number from 0 to 2**32 − 1"
                )
            self._channels[number] = channel
        return None
