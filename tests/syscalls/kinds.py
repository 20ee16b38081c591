"""Which calls are tried in which way, and why the others are not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from tests.syscalls.traced import KILLED_AFTER, KILLED_BEFORE, Call, Injection

ERRORS = ("ENOSPC", "EIO", "EINTR", "EMFILE")
KINDS = (KILLED_BEFORE, KILLED_AFTER, *ERRORS)
MEMORY = frozenset(("mmap", "munmap", "mprotect", "mremap", "brk", "madvise"))
"""Not tried: without memory nothing goes on, and they change nothing that outlives the process."""
ENDS = frozenset(("exit", "exit_group", "rt_sigreturn", "restart_syscall"))
"""Not tried: they cannot fail, and the process is over or its caller does not see them."""
UNFAILING = frozenset(
    ("futex", "getpid", "gettid", "geteuid", "getuid", "getegid", "getgroups", "sched_yield", "umask", "rt_sigaction",
     "rt_sigprocmask", "sigaltstack", "set_robust_list", "rseq", "prlimit64", "sched_getaffinity", "getrusage",
     "clock_gettime", "times", "uname", "sysinfo", "getcwd", "getrandom", "tgkill", "kill")
)  # fmt: skip
"""Only killed: the kernel gives none of the errors for them, or the C library aborts where it does (futex)."""
WAITS = frozenset(("clock_nanosleep", "select", "pselect6", "poll", "ppoll", "wait4", "waitid", "epoll_wait"))
"""Killed, and failing with EINTR alone: the kernel gives none of the other errors for a wait."""
RETRIED = WAITS | {"read", "pread64", "write", "pwrite64", "openat", "fsync", "ftruncate", "flock"}
"""EINTR does no harm here: Python tries again (PEP 475)."""


REPEATED = WAITS | {"futex"}
"""How often these are called depends on time."""
INSTALLED = ("/site-packages", "/lib/python", ".zip")
"""In the calls that look for a package's version."""
FIRST, STRIDE = 4, 25
"""Of calls that are thinned: so many of a name are tried, and one in STRIDE after them."""


def thinned(calls: Sequence[Call]) -> list[Call]:
    """The calls, with but a few of those that a process makes again and again for the same reason."""
    seen, chosen = Counter[str](), list[Call]()
    for call in calls:
        group = "packages" if any(part in call.line for part in INSTALLED) else call.name
        if group not in (*REPEATED, "packages"):
            chosen.append(call)
            continue
        seen[group] += 1
        if seen[group] <= FIRST or seen[group] % STRIDE == 0:
            chosen.append(call)
    return chosen


def kinds_of(name: str) -> Sequence[str]:
    """What is tried at a call."""
    if name in MEMORY or name in ENDS:
        return ()
    if name in UNFAILING:
        return KINDS[:2]
    return (*KINDS[:2], "EINTR") if name in WAITS else KINDS


def injections(calls: Sequence[Call]) -> Iterator[Injection]:
    """Everything that is tried at the calls of some work."""
    for call in calls:
        for kind in kinds_of(call.name):
            yield Injection(call, kind)
