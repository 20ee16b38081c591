"""Reasons for which an exchange with a node ends, as numbers of compiled code and as sentences."""

from __future__ import annotations

from rtloop.drivers.node.frames import BUSY, FLAGS, RANGE, SIZE, UNKNOWN, VERSION_REFUSED, WATCHDOG

RESTARTED, NOT_READY, LINK, SILENT, NOT_A_NUMBER, LINE_GONE = 101, 102, 103, 104, 105, 106
"""Failures that the loop's side sees. The smaller numbers are reasons of the node's refusals."""

TEXTS = {
    VERSION_REFUSED: "the node speaks another version of the protocol; install the node's program that belongs to this "
    "version of rtloop",
    BUSY: "another controller drives this node; stop the other controller",
    UNKNOWN: "the node does not know this loop, so the outputs do not follow the loop; start the loop again",
    WATCHDOG: "no drive reached the node for longer than watchdog_ms, and the node's watchdog has parked the outputs; "
    "check the line, or raise driver.watchdog_ms",
    SIZE: "driver.outputs differs from the number of the node's outputs; set driver.outputs to the node's number",
    RANGE: "the node refused a drive outside the range of the node's output; check the node's program",
    FLAGS: "the node refused a drive with contradictory flags or without a hold time; check the node's program",
    RESTARTED: "the node has restarted, and its outputs are at their safe values; they follow only a new run",
    NOT_READY: "the node has parked its outputs; they follow only a new run",
    LINK: "too many ticks without an answer in time: the error level has reached driver.error_limit; check the line",
    SILENT: "the node does not answer, or the outputs do not reach the safe values; check the node and the line",
    LINE_GONE: "the serial line has ended: the node was unplugged or has restarted; plug it in, then start a new run",
    NOT_A_NUMBER: "the loop gave a drive voltage that is not a number; the driver sent nothing",
}


def failure_text(number: int) -> str:
    """Return the sentence for failure `number`; for an unknown one, a sentence with the number."""
    return TEXTS.get(number, f"the node refused a drive for a reason that this rtloop does not know, number {number}")
