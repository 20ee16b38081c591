"""Which answers came, and which are missing: sequence numbers 1 … highest, 1 … made into one count.

lost        a number that was passed over, until it comes after all
reordered   a number that came after a later one
duplicated  a number that had come before
invalid     no answer to any of the last WINDOW requests
"""

from __future__ import annotations

WINDOW = 1000


class AnswerStream:
    """Counts the answers to `sent` requests; `newest` is the latest of them that was answered."""

    def __init__(self, highest: int) -> None:
        self._highest = highest
        self.sent = self.newest = 0
        self.lost = self.reordered = self.duplicated = self.invalid = 0
        self._missing: set[int] = set()

    def next_sequence(self) -> int:
        """Number of the next request."""
        self.sent += 1
        return self.sequence(self.sent)

    def sequence(self, count: int) -> int:
        """How `count`, from 1, is written in a frame."""
        return (count - 1) % self._highest + 1

    def count_answer(self, sequence: int) -> bool:
        """Count an answer; True where it is newer than all before it."""
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
        """Everything between the newest and `count` is missing; only what could still be taken is remembered."""
        oldest = count - WINDOW
        self._missing = {number for number in self._missing if number > oldest}
        self._missing.update(range(max(self.newest, oldest) + 1, count))
        self.lost += count - self.newest - 1
