"""Counts of received and missing answers, from sequence numbers that run from 1 to the highest and again from 1.

lost        a number that a newer answer skipped, until its answer comes late
reordered   a number whose first answer came after that to a later request
duplicated  a number whose answer had come before
invalid     a number that belongs to none of the last WINDOW requests
"""

from __future__ import annotations

WINDOW = 1000


class AnswerStream:
    """Counts of the answers to `sent` requests; `newest` is the latest answered request's number, 0 before any answer.

    `highest` is the sequence number after which 1 follows.
    """

    def __init__(self, highest: int) -> None:
        """Begin with no request and no answer; the sequence number 1 follows `highest`."""
        self._highest = highest
        self.sent = self.newest = 0
        self.lost = self.reordered = self.duplicated = self.invalid = 0
        self._missing: set[int] = set()

    def next_sequence(self) -> int:
        """Count the next request and return its sequence number."""
        self.sent += 1
        return self.sequence(self.sent)

    def sequence(self, count: int) -> int:
        """Return the sequence number, 1 … `highest`, of request number `count`; the first request has the number 1."""
        return (count - 1) % self._highest + 1

    def count_answer(self, sequence: int) -> bool:
        """Count the answer with the sequence number `sequence`; return whether it is newer than all earlier ones.

        A newer one sets `newest`, and the requests that it skips add to `lost`. Any other answer adds 1 to `reordered`
        and takes 1 from `lost`, or adds 1 to `duplicated` or `invalid`.
        """
        age = (self.sent - sequence) % self._highest
        count = self.sent - age
        if age >= WINDOW or count < 1:
            self.invalid += 1
            return False
        if count > self.newest:
            if count > self.newest + 1:
                self._record_missing(count)
            self.newest = count
            return True
        if count in self._missing:
            self._missing.remove(count)
            self.lost -= 1
            self.reordered += 1
        else:
            self.duplicated += 1
        return False

    def _record_missing(self, count: int) -> None:
        """Count the requests between `newest` and request `count`, both excluded, as lost.

        Lost requests among the WINDOW before `count` are stored: a late answer can still be counted as reordered.
        """
        oldest = count - WINDOW
        self._missing = {number for number in self._missing if number > oldest}
        self._missing.update(range(max(self.newest, oldest) + 1, count))
        self.lost += count - self.newest - 1
