"""Kinds of injection for each system call, and the reasons for calls without any."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from tests.syscalls.traced import KILLED_AFTER, KILLED_BEFORE, Call, Injection

ERRORS = ("ENOSPC", "EIO", "EINTR", "EMFILE")
KINDS = (KILLED_BEFORE, KILLED_AFTER, *ERRORS)
MEMORY = frozenset(("mmap", "munmap", "mprotect", "mremap", "brk", "madvise"))
"""Not tried: a process without memory cannot continue, and these calls change nothing that outlives the process."""
ENDS = frozenset(("exit", "exit_group", "rt_sigreturn", "restart_syscall"))
"""Not tried: they cannot fail; they end the process, or are invisible to their caller."""
UNFAILING = frozenset(
    ("futex", "getpid", "gettid", "geteuid", "getuid", "getegid", "getgroups", "sched_yield", "umask", "rt_sigaction",
     "rt_sigprocmask", "sigaltstack", "set_robust_list", "rseq", "prlimit64", "sched_getaffinity", "getrusage",
     "clock_gettime", "times", "uname", "sysinfo", "getcwd", "getrandom", "tgkill", "kill")
)  # fmt: skip
"""Killed only: the kernel returns no error of ERRORS for these calls, or the C library aborts on it (futex)."""
WAITS = frozenset(("clock_nanosleep", "select", "pselect6", "poll", "ppoll", "wait4", "waitid", "epoll_wait"))
"""Killed, and failing with EINTR alone: the kernel returns no other error of ERRORS for a wait."""
RETRIED = WAITS | {"read", "pread64", "write", "pwrite64", "openat", "fsync", "ftruncate", "flock"}
"""Calls that Python repeats after EINTR (PEP 475): it must do no harm."""


REPEATED = WAITS | {"futex"}
"""Calls whose number depends on time."""
INSTALLED = ("/site-packages", "/lib/python", ".zip")
"""Parts of the paths in calls that look for a package's version."""
FIRST, STRIDE = 4, 25
"""Thinned calls: the first FIRST of a name are tried, then one in STRIDE."""


def thinned(calls: Sequence[Call]) -> list[Call]:
    """Return the calls with only a few of REPEATED and of those that look for packages; see FIRST and STRIDE."""
    counts, chosen = Counter[str](), list[Call]()
    for call in calls:
        group = "packages" if any(part in call.line for part in INSTALLED) else call.name
        if group not in (*REPEATED, "packages"):
            chosen.append(call)
            continue
        counts[group] += 1
        if counts[group] <= FIRST or counts[group] % STRIDE == 0:
            chosen.append(call)
    return chosen


def kinds_for(name: str) -> Sequence[str]:
    """Return the kinds of injection that are tried at a call."""
    if name in MEMORY or name in ENDS:
        return ()
    if name in UNFAILING:
        return KINDS[:2]
    return (*KINDS[:2], "EINTR") if name in WAITS else KINDS


def injections(calls: Sequence[Call]) -> Iterator[Injection]:
    """Yield every injection for these calls."""
    for call in calls:
        for kind in kinds_for(call.name):
            yield Injection(call, kind)
