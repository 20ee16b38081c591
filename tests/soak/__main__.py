"""Tests too long for `make test`: `make soak NAME=day FLAGS="--hours 1"` runs one; without NAME it lists all."""

from __future__ import annotations

import runpy
import sys

LONG_TESTS = {
    "aborts": ("tests.soak.aborts", "Ctrl-C at 20 random moments of experiments; 10 minutes"),
    "api-flood": ("tests.soak.api_flood", "eight clients call the control API beside a paced run"),
    "archive": ("tests.soak.archive", "500 recordings, 7 of them bad, on processes and on Dask; 2 minutes"),
    "backends": ("tests.soak.backends", "one configuration on every backend that needs no hardware; 2 minutes"),
    "busy": ("tests.soak.busy", "runs, services and lost supervisors beside 20 busy loops; 2 hours"),
    "campaign": ("tests.soak.campaign", "campaigns against theory, coverage, efficiency, memory; 15 minutes"),
    "campaign-accidents": ("tests.soak.campaign_accidents", "killed schedulers and workers, a full disk; 3 minutes"),
    "chain": ("tests.soak.chain", "record, identify, design and run 40 random rigs; 10 minutes"),
    "conformance": ("tests.soak.conformance", "9,000 variants of MCAP conformance files; 30 minutes"),
    "connections": ("tests.soak.connections", "2,000 slow clients and all hostile requests; 1 minute"),
    "daemon": ("tests.soak.daemon", "a service on a board for one hour"),
    "day": ("tests.soak.day", "a simulated day around 20 events, a quota, a full disk (root); 30 minutes, 1 GB"),
    "delay": ("tests.soak.delay", "ten rigs with lag and delay: promise against run; coverage of ±; 15 minutes"),
    "fault-mutants": ("tests.faults.mutants", "each planted mistake must fail a row of the fault table; 5 minutes"),
    "fault-pairs": ("tests.faults.pairs", "two faults at once, 100 random pairs; 15 minutes"),
    "flagship": ("tests.soak.flagship", "the paper's loop and the shipped design on one rig; 10 minutes"),
    "forged": ("tests.soak.forged", "500 forged recordings by 1 to 16 jobs, 10,000 through every command; 1 hour"),
    "laws": ("tests.soak.laws", "1,000 live changes of every shipped controller; 15 minutes a seed"),
    "live-changes": ("tests.soak.live_changes", "random changes for 10^8 ticks; 10 minutes, 1 GB"),
    "netem": ("tests.soak.netem", "the driver udp behind tc netem, counted on both sides (root); 5 minutes"),
    "node-wire": ("tests.soak.node_wire", "delays, and 10^7 datagrams of which one in 10^6 is lost; 10 minutes"),
    "pages": ("tests.site.run_pages", "every command of every page that needs no hardware and no root; 20 minutes"),
    "panel-load": ("tests.soak.panel_load", "lateness of a paced run with and without four panels (root)"),
    "panel-triggers": ("tests.soak.panel_triggers", "the panel's trigger finds 10,000 pulses of one tick; 10 minutes"),
    "parts": ("tests.soak.parts", "hysteresis from parts of loops on 50 random rigs; 2 minutes"),
    "planted": ("tests.planted", "mistakes from tests/planted, one at a time: each must fail its tests; 1 hour"),
    "recordings": ("tests.soak.recordings", "killed runs, damaged files, an hour at 10 kHz; 30 minutes, 2 GB"),
    "retune": ("tests.soak.retune", "a service follows a resonance that moved; 10 minutes"),
    "retune-gain": ("tests.soak.retune_gain", "a service follows a gain that moved; 5 minutes"),
    "robust": ("tests.soak.robust_chain", "`design auto --robust` on 20 random rigs: promise against run; 30 minutes"),
    "syscalls": ("tests.syscalls", "every system call fails, or is the last before SIGKILL; 90 minutes, needs strace"),
    "surroundings": ("tests.surroundings", "every command in odd folders, environments, streams; 2 hours, --short 1"),
    "wheel": ("tests.soak.wheel", "README's commands from the wheel in a fresh environment; 5 minutes, needs an index"),
    "worlds": ("tests.worlds.__main__", "services in virtual time, faults and requests drawn; 10 minutes, --minutes"),
}  # fmt: skip
"""Module of each long test, and the description in the list: subject, duration, needs."""


def main() -> None:
    """Run the long test named by the first argument with the other arguments; without arguments, list all."""
    if len(sys.argv) > 1 and sys.argv[1] in LONG_TESTS:
        sys.argv = sys.argv[1:]
        runpy.run_module(LONG_TESTS[sys.argv[0]][0], run_name="__main__")
        return
    for name, (_, purpose) in LONG_TESTS.items():
        print(f"{name:18} {purpose}")
    if len(sys.argv) > 1:
        sys.exit(f"soak: name is {sys.argv[1]!r}; allowed: one of the names above")


if __name__ == "__main__":
    main()
