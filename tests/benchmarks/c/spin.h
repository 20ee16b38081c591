/* An empty paced loop, which spins all the time like rtloop.engine.clock without sleep: it shows the host's own delays.
 * `late` is 1 if a tick ended after its period; `skipped` is the number of periods that had passed before a tick. */
#pragma once
#include <stdint.h>
#include <time.h>

static inline int64_t monotonic_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000ll + now.tv_nsec;
}

/* `ticks` deadlines [ns since the start] with `late` and `skipped`. */
void spin(double period_ns, int64_t ticks, double *deadline_ns, double *late, double *skipped) {
    int64_t start_ns = monotonic_ns() + 1000000, index = 0;
    for (int64_t k = 0; k < ticks; k++, index++) {
        int64_t now_ns = monotonic_ns(), due_ns = start_ns + (int64_t)((double)index * period_ns);
        skipped[k] = 0;
        if (now_ns > due_ns) {
            skipped[k] = (double)(int64_t)((double)(now_ns - due_ns) / period_ns);
            index += (int64_t)skipped[k];
            due_ns = start_ns + (int64_t)((double)index * period_ns);
        }
        while (now_ns < due_ns) now_ns = monotonic_ns();
        deadline_ns[k] = (double)(due_ns - start_ns);
        late[k] = (double)(monotonic_ns() - due_ns) > period_ns;
    }
}
